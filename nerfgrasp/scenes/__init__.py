"""Scenes: in memory, in folders, what is known to be true of them, and the grasps that are valid there."""
