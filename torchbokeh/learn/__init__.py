"""In training and deployment: augmentation, integration networks, export."""
