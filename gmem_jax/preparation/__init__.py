"""Preparation of packs: gas, pressure, frictionless cycles, rest, and the ringing period."""
