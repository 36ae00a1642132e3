"""Planner of the scripted expert: where the gripper goes next, from the model's collision geometry."""
