"""How grains are moved through a protocol: knows walls, stages and bins, and no memory experiment."""
