"""Many independent jobs: in this process, in local processes, or on a Ray cluster.

It imports no other room. Open `processes.py` first, or `pool.py`; which one to use:

- Few long jobs, such as one recording each, where the failure of one must not spoil the others: `crew.Crew`, which
  takes `processes.run_here`, `processes.run_in_processes` or `on_ray.run_on_ray`. All three take the same function. An
  exception of a job is its result. A job calls `tick` now and then; an interrupt is raised there.
- Many short tasks in several rounds, whose results are wanted in order: `pool.Workers`. Its processes are kept from
  round to round. The first exception stops all tasks.

In both, the function must be defined at the top level of a module, since it is sent to the
workers by name. Tasks, jobs and results are pickled. Each worker has one BLAS thread, leaves Ctrl-C to its parent, and
ends when its parent dies (`workers`).
"""
