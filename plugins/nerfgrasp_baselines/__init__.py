"""Grasping methods that the main one is compared with, each found through its entry point."""
