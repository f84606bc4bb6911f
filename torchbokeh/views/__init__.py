"""Many views through the lens while the shutter is open."""
