"""What a caller hands in: checked once, with depth turned into circles of confusion."""
