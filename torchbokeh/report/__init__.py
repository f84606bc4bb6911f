"""Error against run time: what every operating point of this package gives and costs, beside well-known baselines.

``torchbokeh report`` runs it; nothing here is imported by ``import torchbokeh``.
"""
