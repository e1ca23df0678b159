"""How steps are run: what a step is (`step`), who decides (`plan`), who steps (`executors`), who
calls (`execute`, `simulate`).
"""
