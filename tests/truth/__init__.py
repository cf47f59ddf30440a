"""An AVIS table in the time domain, written apart from the package, with effects that tests hide from `avis gap`.

Nothing here uses the package's own dynamics: Newton-Euler mechanics with a quaternion, analogue sensor electronics
and a Runge-Kutta integration of their own. Only the numbers of the rig file and the containers of a campaign are
shared.
"""
