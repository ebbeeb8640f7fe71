"""Motors: from the actions of a policy to the torques that joints get."""
