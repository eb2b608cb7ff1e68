"""Tasks: geometry, goal, rewards, success and termination, one file each."""
