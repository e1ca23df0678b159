"""Studies: many runs of a scenario, and what they say together.

    what is asked    compare (laws), monte_carlo (random parameters), sweep (a grid of them),
    sensitivity (which parameter matters) what comes back  comparison, study, dataset (the table of
    a sweep) cases            designs -> draws, points: which parameters case i has; setup: all of
    it checked and ready searching        cube: the same cases as a box to climb in
    running          blocks: the one compiled shape; progress, interrupt
    keeping          config -> store: a sweep on disk that survives a kill
    numbers          statistics, summaries

The public names are those of `iblf_jax`; `distributions` has those of parameters, `distributed` is
for several processes.
"""
