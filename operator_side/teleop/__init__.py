"""Driving by hand: keys or a gamepad to leased twists."""
