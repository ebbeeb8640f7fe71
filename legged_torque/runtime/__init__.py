"""From an exported policy to a robot: a control loop with brakes, and a simulated robot that speaks the same messages.

Needs neither torch nor Warp.
"""
