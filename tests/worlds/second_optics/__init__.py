"""A second optical world: its own film, its own ray tracer, its own camera.

It shares no code with `membrane_ctrl` or `firmware_iface`; it writes capture sets in the format of
docs/reference/interfaces.md, with known truth. A test of the metrology that uses it cannot pass
because simulator and inverse have the same mistake.

How to use it
-------------
A sound bench of a quarter of the resolution (612 x 512), exactly as stated, and one set::

    from tests.worlds.second_optics import Mirror, World
    truth = World(Mirror(), seed=1).write_set(tmp_path / "set1")
    # truth.sag_um, truth.zernike_um[j - 1] (Noll j), truth.displacement_um

Another film: finite strains, orthotropic, on a ring that is neither plane nor round::

    Mirror(sag_mm=37.1, material=Material(ratio=0.92, direction_rad=0.6, prestrain=(1e-4, 1e-4, 0)),
           ring=Ring(height={2: (3e-4, 0.0)}),          # in radii: 0.15 mm of saddle
           wrinkles=Wrinkles(amplitude_um=20.0))
    drawn_mirror(rng, orthotropic=True)                 # a random one
    mirror.seated(drawn_seat(rng, 120.0))               # turned by 120 degrees, by hand
    mirror.height_mm(x_mm, y_mm, displacement_um)       # its truth anywhere

Effects are planted one by one, each with a size; see `effects.Effects` for all of them::

    Effects(camera_motion=step_motion(YAW, 5e-6, at_s=2.0))       # knocked by 5 urad after 2 s
    Effects(screen_motion=ramp_motion(SHIFT_1, 0.01, end_s=10.0)) # creeps by 10 um
    Effects(film_motion_um=lambda time_s: 5.0 * (time_s > 1.0), laser=False)
    Effects(panel=Panel(previous_share=0.03))                     # LCD response
    Effects(panel=Panel(ghost=Ghost(0.01)))                       # second reflection
    Effects(panel=Panel(gamma=1.6, gamma_by_angle=0.3))
    Effects(panel=Panel(falloff=0.12))                            # or falloff_slope=0.12
    Effects(sensor=Sensor(bits=12, container="left-aligned", exposure=1.6))
    Effects(sensor=Sensor(container="video range"))               # or response_gamma=2.2
    Effects(orientation="rotated 180")                            # the camera is upside down
    Effects(laser_scale=1.01)

What the set states is the paper's bench unless `Stated` says otherwise. A bench that is not as
stated, errors by the names of `bench.HAND_SIGMAS`::

    bench = Bench.paper().changed({"camera_yaw_deg": 0.1, "bow_mm": 0.8})
    World(mirror, bench, Effects(), Stated(sigma_share=1.0)).write_set(folder)
    drawn_errors(rng, share=1.0)                        # all of them at random

`Stated(sigma_share=0.01)` states sigmas of a hundredth, so that the geometry's bar hides nothing.
`Stated(camera={"distortion": [-3.0, 0.0, 0.0, 0.0]})` misstates the lens: it folds in the picture.

A clear film in front of the mirror (a cushion), which the set states or not::

    World(mirror, clear_film=ClearFilm(), stated=Stated(front_film={"bulge_mm": 63.4}))

Tracking: a full set as reference, then a set of crossed frames at `FRAME_S` apart; time runs on
from `begin_s`, so that a motion may begin after the reference::

    world.write_set(tmp_path / "full")
    world.write_track(tmp_path / "track", tmp_path / "full", count_frames=20, begin_s=5.0)

Several pressures (for `calibrate` and `film`): `write_set(folder, displacement_um=-2000.0,
pressure_pa=...)`; `mirror.load(displacement_um)` is proportional to the pressure.

Frames in memory: `world.frames(pictures, displacement_um)`; exact screen places of the pixels
without pattern and noise: `world.screen_map(displacement_um)`.

`tests.studies.second_world_errors.measured_errors` measures a set and compares it with its truth.

Cost on one core: 0.4 s to solve a film, 1 to 2 s a set of 18 frames at a quarter of the resolution
(`Bench.paper(0.125)`: a quarter of that; `Bench.paper(1.0)`: full size). With a moving camera or
screen every frame is traced: 0.4 s each.
"""

from tests.worlds.second_optics.bench import HAND_SIGMAS, Bench, drawn_errors
from tests.worlds.second_optics.clear_film import ClearFilm
from tests.worlds.second_optics.effects import (
    Effects,
    Ghost,
    Panel,
    Sensor,
    ramp_motion,
    step_motion,
)
from tests.worlds.second_optics.film import Material, Ring
from tests.worlds.second_optics.mirror import Mirror, Wrinkles, drawn_mirror
from tests.worlds.second_optics.seat import Seat, drawn_seat
from tests.worlds.second_optics.world import FRAME_S, Stated, Truth, World

# degrees of freedom of a motion; of the screen they are along and about s_x, s_y and out
SHIFT_1, SHIFT_2, SHIFT_3, PITCH, YAW, ROLL = range(6)

__all__ = [
    "FRAME_S",
    "HAND_SIGMAS",
    "PITCH",
    "ROLL",
    "SHIFT_1",
    "SHIFT_2",
    "SHIFT_3",
    "YAW",
    "Bench",
    "ClearFilm",
    "Effects",
    "Ghost",
    "Material",
    "Mirror",
    "Panel",
    "Ring",
    "Seat",
    "Sensor",
    "Stated",
    "Truth",
    "World",
    "Wrinkles",
    "drawn_errors",
    "drawn_mirror",
    "drawn_seat",
    "ramp_motion",
    "step_motion",
]
