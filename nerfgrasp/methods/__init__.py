"""Grasping methods: their interface, how they are found and loaded, and Ψ with its search."""
