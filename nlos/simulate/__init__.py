"""Captures of known hidden scenes: the truth that reconstructions are compared with."""

from nlos.simulate.points import PointScene
from nlos.simulate.walls import WALLS, relay_wall

__all__ = ["WALLS", "PointScene", "relay_wall"]
