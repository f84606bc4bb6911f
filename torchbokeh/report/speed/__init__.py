"""Error against run time, and what the time depends on."""
