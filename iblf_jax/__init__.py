"""iblf_jax: simulate, compare, certify and tune barrier-Lyapunov tracking controllers of
constrained robots, in JAX.
"""

from iblf_jax import _start as _start

# isort: split
import sys as _sys
from importlib.metadata import version as _version
from typing import TYPE_CHECKING

from iblf_jax import presets as presets
from iblf_jax.control import actuators as actuators
from iblf_jax.control import barriers as barriers
from iblf_jax.control import controllers as controllers
from iblf_jax.control import decays as decays
from iblf_jax.control import observers as observers
from iblf_jax.control import sensors as sensors
from iblf_jax.core import linalg as linalg
from iblf_jax.core import pytree as pytree
from iblf_jax.core import status as status
from iblf_jax.core.first_use import on_first_use as _on_first_use
from iblf_jax.core.process_end import finish_at_exit as _finish_at_exit
from iblf_jax.core.programs import bound_programs as _bound_programs
from iblf_jax.core.pytree import Leaf as Leaf
from iblf_jax.core.pytree import astype as astype
from iblf_jax.core.pytree import component as component
from iblf_jax.core.pytree import leaf as leaf
from iblf_jax.core.pytree import static as static
from iblf_jax.core.status import Status as Status
from iblf_jax.engine.explain import explain as explain
from iblf_jax.engine.runs import Runs as Runs
from iblf_jax.engine.simulate import SimulationError as SimulationError
from iblf_jax.engine.simulate import SimulationWarning as SimulationWarning
from iblf_jax.engine.simulate import simulate as simulate
from iblf_jax.files.rollouts import save_rollouts as save_rollouts
from iblf_jax.files.scenario import load_scenario as load_scenario
from iblf_jax.files.scenario import save_scenario as save_scenario
from iblf_jax.simulation import metrics as metrics
from iblf_jax.simulation import paths as paths
from iblf_jax.simulation.initial import Initial as Initial
from iblf_jax.simulation.paths import parameters as parameters
from iblf_jax.simulation.paths import with_parameters as with_parameters
from iblf_jax.simulation.results import Metrics as Metrics
from iblf_jax.simulation.results import Rollout as Rollout
from iblf_jax.simulation.sampling import EventTrigger as EventTrigger
from iblf_jax.simulation.sampling import Sampling as Sampling
from iblf_jax.simulation.scenario import Scenario as Scenario
from iblf_jax.simulation.scenario import with_parts as with_parts
from iblf_jax.simulation.vector_field import VectorField as VectorField
from iblf_jax.simulation.vector_field import vector_field as vector_field
from iblf_jax.studies.distributions import choice as choice
from iblf_jax.studies.distributions import factor as factor
from iblf_jax.studies.distributions import interval as interval
from iblf_jax.studies.distributions import joint_normal as joint_normal
from iblf_jax.studies.distributions import joint_samples as joint_samples
from iblf_jax.studies.distributions import log_uniform as log_uniform
from iblf_jax.studies.distributions import normal as normal
from iblf_jax.studies.distributions import offset as offset
from iblf_jax.studies.distributions import uniform as uniform
from iblf_jax.studies.distributions import value as value
from iblf_jax.world import bounds as bounds
from iblf_jax.world import disturbances as disturbances
from iblf_jax.world import plants as plants
from iblf_jax.world import process_noise as process_noise
from iblf_jax.world import references as references
from iblf_jax.world import regions as regions
from iblf_jax.world import robots as robots
from iblf_jax.world.bounds import Bounds as Bounds

__version__ = _version("iblf_jax")
_bound_programs()
_finish_at_exit()

_PUBLIC_MODULES = {
    "control": ("actuators", "barriers", "controllers", "decays", "observers", "sensors"),
    "world": (
        "bounds",
        "disturbances",
        "plants",
        "process_noise",
        "references",
        "regions",
        "robots",
    ),
}
"""Folder -> its modules, which users import as `iblf_jax.NAME`."""


def _keep_public_import_paths() -> None:
    """Make `import iblf_jax.robots` the same module as `iblf_jax.world.robots`, submodules
    included.
    """
    for folder, names in _PUBLIC_MODULES.items():
        for name in names:
            home = f"iblf_jax.{folder}.{name}"
            for module in [
                key for key in _sys.modules if key == home or key.startswith(f"{home}.")
            ]:
                _sys.modules[module.replace(home, f"iblf_jax.{name}", 1)] = _sys.modules[module]


_keep_public_import_paths()

if TYPE_CHECKING:
    from iblf_jax import certificates as certificates
    from iblf_jax import deployment as deployment
    from iblf_jax import plotting as plotting
    from iblf_jax import proofs as proofs
    from iblf_jax import studies as studies
    from iblf_jax import testing as testing
    from iblf_jax import tuning as tuning
    from iblf_jax.certificates import Certificate as Certificate
    from iblf_jax.certificates import Counterexample as Counterexample
    from iblf_jax.certificates import certify as certify
    from iblf_jax.deployment.cosimulate import cosimulate as cosimulate
    from iblf_jax.deployment.export import Exported as Exported
    from iblf_jax.deployment.export import export as export
    from iblf_jax.deployment.live import explore as explore
    from iblf_jax.engine.period import recommended_period as recommended_period
    from iblf_jax.files.results import load as load
    from iblf_jax.files.tuning import tune_file as tune_file
    from iblf_jax.identification import Identification as Identification
    from iblf_jax.identification import excitation as excitation
    from iblf_jax.identification import identify as identify
    from iblf_jax.proofs import GuaranteedGains as GuaranteedGains
    from iblf_jax.proofs import Proof as Proof
    from iblf_jax.proofs import gains_for_guarantee as gains_for_guarantee
    from iblf_jax.proofs import largest_level as largest_level
    from iblf_jax.proofs import largest_parameters as largest_parameters
    from iblf_jax.proofs import largest_period as largest_period
    from iblf_jax.proofs import prove as prove
    from iblf_jax.reports import report as report
    from iblf_jax.studies.compare import compare as compare
    from iblf_jax.studies.comparison import Comparison as Comparison
    from iblf_jax.studies.monte_carlo import monte_carlo as monte_carlo
    from iblf_jax.studies.rare_events.result import FailureProbability as FailureProbability
    from iblf_jax.studies.sensitivity import Sensitivity as Sensitivity
    from iblf_jax.studies.sensitivity import sensitivity as sensitivity
    from iblf_jax.studies.store import StoreError as StoreError
    from iblf_jax.studies.study import Study as Study
    from iblf_jax.studies.sweep import load_sweep as load_sweep
    from iblf_jax.studies.sweep import sweep as sweep
    from iblf_jax.studies.time_step import recommended_dt as recommended_dt
    from iblf_jax.tuning import ParetoFront as ParetoFront
    from iblf_jax.tuning import TuneResult as TuneResult
    from iblf_jax.tuning import WorstCase as WorstCase
    from iblf_jax.tuning import cvar as cvar
    from iblf_jax.tuning import failure_probability as failure_probability
    from iblf_jax.tuning import falsify as falsify
    from iblf_jax.tuning import objectives as objectives
    from iblf_jax.tuning import pareto as pareto
    from iblf_jax.tuning import tunable as tunable
    from iblf_jax.tuning import tune as tune

_ON_FIRST_USE = {
    "WorstCase": ("iblf_jax.tuning", "WorstCase"),
    "Certificate": ("iblf_jax.certificates", "Certificate"),
    "certificates": ("iblf_jax.certificates", None),
    "certify": ("iblf_jax.certificates", "certify"),
    "compare": ("iblf_jax.studies.compare", "compare"),
    "Comparison": ("iblf_jax.studies.comparison", "Comparison"),
    "cosimulate": ("iblf_jax.deployment.cosimulate", "cosimulate"),
    "Counterexample": ("iblf_jax.certificates", "Counterexample"),
    "cvar": ("iblf_jax.tuning", "cvar"),
    "deployment": ("iblf_jax.deployment", None),
    "explore": ("iblf_jax.deployment.live", "explore"),
    "export": ("iblf_jax.deployment.export", "export"),
    "Exported": ("iblf_jax.deployment.export", "Exported"),
    "failure_probability": ("iblf_jax.tuning", "failure_probability"),
    "FailureProbability": ("iblf_jax.studies.rare_events.result", "FailureProbability"),
    "falsify": ("iblf_jax.tuning", "falsify"),
    "ParetoFront": ("iblf_jax.tuning", "ParetoFront"),
    "excitation": ("iblf_jax.identification", "excitation"),
    "gains_for_guarantee": ("iblf_jax.proofs", "gains_for_guarantee"),
    "GuaranteedGains": ("iblf_jax.proofs", "GuaranteedGains"),
    "Identification": ("iblf_jax.identification", "Identification"),
    "identify": ("iblf_jax.identification", "identify"),
    "largest_level": ("iblf_jax.proofs", "largest_level"),
    "largest_parameters": ("iblf_jax.proofs", "largest_parameters"),
    "largest_period": ("iblf_jax.proofs", "largest_period"),
    "load": ("iblf_jax.files.results", "load"),
    "load_sweep": ("iblf_jax.studies.sweep", "load_sweep"),
    "monte_carlo": ("iblf_jax.studies.monte_carlo", "monte_carlo"),
    "objectives": ("iblf_jax.tuning.objectives", None),
    "pareto": ("iblf_jax.tuning", "pareto"),
    "plotting": ("iblf_jax.plotting", None),
    "Proof": ("iblf_jax.proofs", "Proof"),
    "proofs": ("iblf_jax.proofs", None),
    "prove": ("iblf_jax.proofs", "prove"),
    "recommended_dt": ("iblf_jax.studies.time_step", "recommended_dt"),
    "recommended_period": ("iblf_jax.engine.period", "recommended_period"),
    "report": ("iblf_jax.reports", "report"),
    "Sensitivity": ("iblf_jax.studies.sensitivity", "Sensitivity"),
    "sensitivity": ("iblf_jax.studies.sensitivity", "sensitivity"),
    "StoreError": ("iblf_jax.studies.store", "StoreError"),
    "studies": ("iblf_jax.studies", None),
    "Study": ("iblf_jax.studies.study", "Study"),
    "sweep": ("iblf_jax.studies.sweep", "sweep"),
    "testing": ("iblf_jax.testing", None),
    "tunable": ("iblf_jax.tuning", "tunable"),
    "tune": ("iblf_jax.tuning", "tune"),
    "tuning": ("iblf_jax.tuning", None),
    "tune_file": ("iblf_jax.files.tuning", "tune_file"),
    "TuneResult": ("iblf_jax.tuning", "TuneResult"),
}
"""Public name -> (module, attribute or None for the module itself): imported when first used, so
that `import iblf_jax` stays quick and brings neither matplotlib nor optax nor xarray."""

__getattr__, __dir__ = _on_first_use(__name__, _ON_FIRST_USE)
