"""Figures and animations of runs, studies and tunings; only this folder imports matplotlib.

    run.plot()                                                      the overview of one run
    figures = plotting.paper_figures({"iBLF": run, "log-BLF": other})
    plotting.save(figures, "figures")                               PNG and PDF
    plotting.animate(run, "arm.gif")                                or "arm.html"

Functions for runs take one run or a dict of runs by name (`overview`: one run) and return a
matplotlib Figure, which a notebook shows if it is the value of a cell.  Runs may differ in length;
select one run of a batch first.

Every function also takes `style="paper"` (one column of IEEE), or a `Paper` with another publisher
or two columns, and `figure=`, a matplotlib Figure or SubFigure to draw into, which it returns.

`ax=` draws into the user's panels, and returns them: an Axes, or as many as the figure has panels,
`plotting.positions(run, ax=plt.subplots(2)[1])` for two joints.  There a figure against time has no
column that magnifies the start; with `zoom=0.3` the panels show the first 0.3 s.  The first Axes
has the title and the legend.  `comparison`, `failure_probability`, `identification`, `overview` and
`tuning` arrange panels of several kinds, and refuse `ax=`.
"""

from iblf_jax.plotting._failures import failure_probability as failure_probability
from iblf_jax.plotting._figures import adaptation as adaptation
from iblf_jax.plotting._figures import errors as errors
from iblf_jax.plotting._figures import joint as joint
from iblf_jax.plotting._figures import levels as levels
from iblf_jax.plotting._figures import paper_figures as paper_figures
from iblf_jax.plotting._figures import phase_portrait as phase_portrait
from iblf_jax.plotting._figures import positions as positions
from iblf_jax.plotting._figures import region_margins as region_margins
from iblf_jax.plotting._figures import save as save
from iblf_jax.plotting._figures import torques as torques
from iblf_jax.plotting._figures import tube as tube
from iblf_jax.plotting._figures import uncertain_terms as uncertain_terms
from iblf_jax.plotting._figures import velocities as velocities
from iblf_jax.plotting._figures import velocity_errors as velocity_errors
from iblf_jax.plotting._figures import velocity_portrait as velocity_portrait
from iblf_jax.plotting._identification import identification as identification
from iblf_jax.plotting._overview import overview as overview
from iblf_jax.plotting._proofs import guaranteed_tube as guaranteed_tube
from iblf_jax.plotting._studies import bands as bands
from iblf_jax.plotting._studies import first_exit as first_exit
from iblf_jax.plotting._studies import histograms as histograms
from iblf_jax.plotting._studies import scatter as scatter
from iblf_jax.plotting._studies import study_overview as study_overview
from iblf_jax.plotting._style import Paper as Paper
from iblf_jax.plotting._sweeps import heat_map as heat_map
from iblf_jax.plotting._sweeps import parallel as parallel
from iblf_jax.plotting._tuning import pareto as pareto
from iblf_jax.plotting._tuning import paths as paths
from iblf_jax.plotting._tuning import tuning as tuning
from iblf_jax.plotting._workspace import workspace as workspace
from iblf_jax.plotting.animation import animate as animate
from iblf_jax.plotting.comparison import comparison as comparison
