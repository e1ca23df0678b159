"""Parameters of a robot from its log, with what the log cannot tell.

    known = ij.identify(scenario, "log.csv", ["robot.mass", "robot.damping"])
    known.scenario, known.perturbations, known.plot(), known.save("report.html")

`log`           what was logged, read and checked            `coordinates`  what is looked for, so
that bodies stay bodies `smoothing`, `regression`  the start                         `shooting`
simulation error over windows `search`        Gauss-Newton inside limits
`statistics`   standard errors, and what cannot be told `structure`     terms that the fit lacks
`result`       `Identification` `_excitation`   a reference that makes a log tell much
"""

from iblf_jax.identification._excitation import excitation as excitation
from iblf_jax.identification._identify import identify as identify
from iblf_jax.identification.result import Identification as Identification
