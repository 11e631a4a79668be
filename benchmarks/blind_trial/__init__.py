"""The blind trial of `bench diagnose`: an own simulator hides effects and mistakes, a sealed score tells.

It shares nothing with the application but the table of readings: other geometry, other forms, other shapes.
"""
