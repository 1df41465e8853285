"""Pose parameterizations: how a grasp pose becomes the numbers that gradient ascent moves."""
