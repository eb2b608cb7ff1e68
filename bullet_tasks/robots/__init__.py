"""Robots as a task sees them: a state, a command, a substep."""
