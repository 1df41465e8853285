"""Simulation in PyBullet: objects, tasks, pictures and grasp attempts. Only this package imports pybullet."""
