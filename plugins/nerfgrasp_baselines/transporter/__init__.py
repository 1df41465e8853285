"""The method `transporter` (TN): where to grasp, picked among the pixels and rotations of a height map.

Source: Zeng et al. 2020, "Transporter Networks: Rearranging the Visual World for Robotic Manipulation": its attention
module alone, as the paper compares with it.
"""
