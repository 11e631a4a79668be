"""The blind trial of `bench diagnose`: an independent simulator hides effects and mistakes, and a sealed score
judges.

It shares only the table of readings with the application: its geometry, forms and shapes of effects are its own.
"""
