"""Probabilities of rare failures of a function of standard normal numbers.

    limit_state   what the algorithms evaluate, and what they return
    crude         Monte-Carlo simulation with a Clopper-Pearson interval
    subset        subset simulation: conditional levels and Markov chains
    importance    sampling around the design points
    design_points the failures nearest to the origin, by gradients
    normal_space  the perturbations of a scenario as functions of standard normal numbers
    result        what `ij.failure_probability` returns

Nothing but `normal_space` and `result` depends on scenarios, so that the algorithms are tested on
functions whose probabilities are known.
"""
