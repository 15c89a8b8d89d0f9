"""How a pack is made: gas, pressure, frictionless cycles, rest, and the ringing period of what came out."""
