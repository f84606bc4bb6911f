"""Motion against dense scatters and the accumulation buffer."""
