"""The simulation of grains through a protocol of stages; it knows no memory experiment."""
