"""6-DoF grasp poses from RGB images: a multi-view NeRF, a grasp value on top of it, and gradient ascent."""

__version__ = "0.1.0"
