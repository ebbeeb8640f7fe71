"""What stands between the torques that a policy asks for and those that the joints get."""
