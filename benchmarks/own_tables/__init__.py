"""Five vibration isolation tables of a user's own, simulated independently of `avis_ctrl`.

Nothing here imports `avis_ctrl`: the physics is written a second time, from the equations (Newton and Euler with a
quaternion instead of Tait-Bryan angles, sensors driven by the acceleration that they feel, an explicit
integration between samples), so that a verdict of the product can be held against something that shares no line with
it.

- `physics`: what a table is made of (`Table`, `Mount`, `Drive`, `Geophone`, `Accelerometer`, `PositionSensor`,
  `FloorVelocity`), `floor_motion`, and `simulate`: commands, floor, noise and an optional sampled controller in;
  sensor volts, drive volts and the true motion out.
- `kernel`: the compiled equations of motion behind it.
- `campaign`: measurement campaigns in every usual form, written as `avis-campaign` HDF5 files (`write_campaign`).
- `closed_loop`: a sampled controller (`controller.json` of `avis export`) on a table: `linearise` (spectral radius of
  the one-sample map, axis of the least stable mode), `run` (stable or not, r.m.s. velocity), `transmissibility`.
- `agreement`: the two routes of `closed_loop` against each other on all tables.
- `tables`: the five tables, `NOMINAL[name]()` as a rig file would say, `truth(name, seed)` as the table really is.

Use, from the root of the repository:

    python -m benchmarks.own_tables.tables                       # nominal numbers of the five tables, as TOML
    python -m benchmarks.own_tables.campaign tripod logical c.h5 # a campaign, drives through logical axes
    python -m benchmarks.own_tables.closed_loop tripod controller.json   # verdict on an exported controller

or in Python:

    from benchmarks.own_tables import tables, campaign, closed_loop
    table = tables.truth("tripod", seed=1)
    campaign.write_campaign(table, "logical", "campaign.h5", seed=2, floor_measured=True)
    controller = closed_loop.Controller.read("export/controller.json")
    print(closed_loop.linearise(table, controller))       # spectral radius, mode, axis
    print(closed_loop.run(table, controller, seconds=60.0, seed=3))
    frequency, T = closed_loop.transmissibility(table, controller)

Conventions: SI units; x, y horizontal, z up; places relative to the geometric centre that the rig file uses; positive
feedback u = K y, y sensor volts and u drive volts in the order of the table. A command u_k computed at sample k acts
from t_k + `loop_delay_s` on, held for one sample. A sensor read at the instant of a step of the drive voltage shows the
value before it.
"""
