"""The third trial of the diagnosis, whose geometry, effects, noise and mistakes are written again, apart from
`bench`.
"""
