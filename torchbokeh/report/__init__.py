"""Error against run time: what every operating point of this package gives and costs, beside well-known baselines.

``torchbokeh report`` runs it; nothing here is imported by ``import torchbokeh``. Imports run one way, from the first to
the last of these, and rooms of one line do not import each other:

* `rows`, `machine`, `sheets`, `internals`, and `scenes`, `measure`, `markdown`, `settings`, `experiment` and `figures`
  on top of them: what all experiments share. `internals` alone knows the inside of the package.
* `speed`, `motion`, `chromatic`, `psfs`, `stability`: the experiments, each with its tables and plots.
* `experiments`, the table of those of ``report.md``; the other two chapters have theirs in their rooms. A new
  experiment is a file and a line in its table.
* `chapter` of those, and `write`, then `chapters`, then `command`.
"""
