"""Parameters of a robot from its log, with their uncertainty.

    known = ij.identify(scenario, "log.csv", ["robot.mass", "robot.damping"])
    known.scenario, known.perturbations, known.plot(), known.save("known.npz")

`_identify`             the public function: options, problem, search, result
`problem`               what is identified, from which data
`log`                   logs, read and checked
`bag`                   logs from rosbag2 recordings
`coordinates`           parameters, and coordinates in which all points are rigid bodies
`smoothing`             velocities and accelerations from positions
`regression`            the initial estimate
`replay`                the plant under a logged torque, and its sensitivities
`shooting`              simulation error over windows (multiple shooting)
`standstill`            free torques in place of the friction law near standstill
`levenberg_marquardt`   the Levenberg-Marquardt method inside limits
`statistics`            standard errors, identifiability, whiteness
`missing_terms`         terms that the model lacks
`assessment`            verdicts and notes about a fit
`result`                `Identification`
`_excitation`           a reference that makes parameters identifiable
"""

from iblf_jax.identification._excitation import excitation as excitation
from iblf_jax.identification._identify import identify as identify
from iblf_jax.identification.result import Identification as Identification
