"""The tables of a scene file, and an accuracy.

The `Attributes` of each docstring are the meanings that `docs/reference.md` shows beside the units
and ranges of the fields, see `scripts/reference_page.py`.
"""

import dataclasses
from typing import Any

from codesign_jax.scene import rigid_bodies
from codesign_jax.scene.schema import choice, quantity, table


@dataclasses.dataclass(frozen=True)
class Effects:
    """Parts of the physics; an effect that is off has no joint, contact or branch in the program.

    `codesign_jax.scene.effects` says what each means and which engines have it.  The bending law,
    `neo_hookean`, may be omitted in a file, and then follows the hand's material; in a `Scene` it
    always has a value.
    """

    lateral_bending: bool = True
    twist: bool = True
    wrist: bool = True
    finger_object: bool = True
    palm_object: bool = True
    finger_table: bool = True
    palm_table: bool = True
    object_table: bool = True
    table: bool = True
    finger_finger: bool = False
    finger_palm: bool = False
    finger_itself: bool = False
    surface: str = choice("spheres", "hull", default="spheres")
    friction: str = choice("none", "coulomb", default="coulomb")
    friction_memory: bool = False
    disturb: bool = True
    ungrasp: bool = True
    neo_hookean: bool | None = None
    lateral_threshold: bool = False
    pressure_dynamics: bool = False
    air_mass: bool = False
    section_growth: bool = False
    gravity: bool = True


@table
@dataclasses.dataclass(frozen=True)
class Fixture:
    """A static body of the surroundings, which fingers, palm and object touch like the table.

    Attributes:
      name: Its name, as in messages.
      type: Its shape; a plane has its body below it.
      position: Its centre, or a point of a plane; the table is z = 0, the object at the origin.
      size: Half lengths of a box, or radius and half height of a cylinder.
      orientation: Roll, pitch and yaw, which turn about x, y and z in this order, or a unit
        quaternion w, x, y, z. An unturned cylinder stands, the normal of a plane is z.
      friction: Coulomb coefficient with hand and object. Not given: the table's, which are
        `contact.finger_table_friction` with the hand and `[table]` of the object file.
    """

    name: str
    type: str = choice("box", "cylinder", "plane")
    position: tuple[float, ...] = quantity("m", -2, 2, structure=True)
    size: tuple[float, ...] | None = quantity("m", 0.001, 2, structure=True, default=None)
    orientation: tuple[float, ...] | None = quantity(
        "deg or quaternion", -360, 360, structure=True, default=None
    )
    friction: float | None = quantity("", 0, 5, default=None)

    @property
    def quaternion(self) -> tuple[float, ...]:
        """Its orientation, a unit quaternion (w, x, y, z)."""
        still = (1.0, 0.0, 0.0, 0.0)
        return still if self.orientation is None else rigid_bodies.turned(self.orientation, still)

    @property
    def half_sizes(self) -> tuple[float, ...]:
        """Three numbers as MuJoCo's geom has them [m]."""
        return (*(self.size or ()), 0.0, 0.0, 0.0)[:3]


@table
@dataclasses.dataclass(frozen=True)
class Phases:
    """End times of the phases of one grasp (paper Fig. 3) [s], from the end of the settling.

    Each phase ends later than the one before it.  The number of time steps belongs to the structure
    of a scene: another end of the last phase needs a new compilation.

    Attributes:
      approach: End of the approach: the arm is at the grasp's height.
      inflate: End of inflation: the chambers have their pressures. Losing the object costs from
        here on.
      lift: End of the lift: the arm is at `arm.start_height` again.
      disturb: End of the disturbance, and of the time in which losing the object costs.
      ungrasp: End of the grasp.
      deflate_time: Time that the chambers take to empty from the start of the un-grasp phase on;
        fits into that phase.
      settle: Time before the grasp in which the arm waits at its start and the object comes to
        rest; it is simulated, but is not part of the cost.
    """

    approach: float = quantity("s", 0.01, 600)
    inflate: float = quantity("s", 0.01, 600)
    lift: float = quantity("s", 0.01, 600)
    disturb: float = quantity("s", 0.01, 600)
    ungrasp: float = quantity("s", 0.01, 600, structure=True)
    deflate_time: float = quantity("s", 0.001, 60)
    settle: float = quantity("s", 0, 60, structure=True, default=0.0)


@table
@dataclasses.dataclass(frozen=True)
class Arm:
    """Start pose, reference height and disturbance of the arm frame X_D.

    Attributes:
      start_height: Height of the arm frame above the table at the start and after the lift.
      zero_height: Height of the arm frame above the table at which the parameter `arm_z` is zero.
      shake_frequency: Frequency of the disturbance. Its periods alternate: one turns the arm by
        roll, the next by pitch.
      shake_amplitude: Amplitude of the disturbance at its end, to which it grows linearly.
      shake_acceleration: Acceleration by which the disturbance also moves the arm frame there and
        back along the world's x, y and z, a third of the phase each.
    """

    start_height: float = quantity("m", 0.05, 2)
    zero_height: float = quantity("m", 0, 1)
    shake_frequency: float = quantity("Hz", 0, 20)
    shake_amplitude: float = quantity("deg", 0, 90)
    shake_acceleration: float = quantity("m/s^2", 0, 100, default=0.0)


@table
@dataclasses.dataclass(frozen=True)
class Cost:
    """Cost of a trial (paper Fig. 3).

    Attributes:
      maximum: Cost of a trial that loses its object at the start of the lift, and the cost that
        tables show for a failed trial; a kept object costs 0.
      lost_distance: The object is lost if the centres of object and hand are at least this far
        apart.
      failure: How a failed trial counts in its particle's mean cost: "exclude" leaves it out (the
        paper's rule), "worst" counts it with `maximum`.
    """

    maximum: float = quantity("", 0.1, 100)
    lost_distance: float = quantity("m", 0.001, 1)
    failure: str = choice("exclude", "worst")


@table
@dataclasses.dataclass(frozen=True)
class Contact:
    """Contact of the rubber skin; see docs/hull.md.

    Attributes:
      normal_stiffness: Normal stiffness of a square of skin as wide as the finger, and of a contact
        sphere; the same for every morphology and time step. A contact with the table is twice as
        stiff.
      dissipation_time: Time constant of the skin's dissipation: its damping over its stiffness.
      friction_ratio: A contact without memory creeps by its friction force / (normal_stiffness *
        ratio * 40 ms): a larger ratio creeps less. MuJoCo's `impratio` follows from it.
      held_friction_ratio: `friction_ratio` of contacts with object, table and fixtures that hold
        friction by `effects.friction_memory`: they do not creep.
      finger_table_friction: Coulomb coefficient of fingers and palm on the table.
      finger_finger_friction: Coulomb coefficient of fingers on fingers and on themselves, only with
        `effects.finger_finger` or `effects.finger_itself`.
      finger_finger_friction_ratio: `friction_ratio` of fingers on one another, on themselves and on
        the palm; spheres have that of all contacts.
      finger_palm_friction: Coulomb coefficient of fingers on the palm, only with
        `effects.finger_palm`.
      finger_palm_stiffness: As `normal_stiffness`, of fingers on the palm.
    """

    normal_stiffness: float = quantity("N/m", 10, 1e6)
    friction_ratio: float = quantity("", 0.01, 1000)
    finger_table_friction: float = quantity("", 0, 5)
    dissipation_time: float = quantity("s", 0, 1, default=0.006)
    held_friction_ratio: float = quantity("", 0.01, 1000, default=5.0)
    finger_finger_friction: float = quantity("", 0, 5, default=0.8)
    finger_finger_friction_ratio: float = quantity("", 0.01, 1000, default=1.0)
    finger_palm_friction: float = quantity("", 0, 5, default=0.8)
    finger_palm_stiffness: float = quantity("N/m", 10, 1e6, default=20e3)


@table
@dataclasses.dataclass(frozen=True)
class Pneumatics:
    """Air of the chambers: its supply, with `pressure_dynamics`, and its law, with `air_mass`.

    Attributes:
      lag: Time constant of the first-order lag of valve and tube.
      rate: Fastest change of pressure.
      maximum: Highest pressure of the supply.
      exponent: n of p V^n = const for a mass of air: 1 isothermal, 1.4 adiabatic.
      atmosphere: Pressure around the hand, which gauge pressures are above.
    """

    lag: float = quantity("s", 0, 10, default=0.1)
    rate: float = quantity("Pa/s", 1e3, 1e9, default=400e3)
    maximum: float = quantity("Pa", 1e3, 1e6, default=200e3)
    exponent: float = quantity("", 1, 1.7, default=1.0)
    atmosphere: float = quantity("Pa", 1e4, 2e5, default=101325.0)


@dataclasses.dataclass(frozen=True)
class Discretization:
    """Time step, segments of a finger and density of the contact points.

    Attributes:
      timestep: Time step.
      links: Segments of a finger, with joints at their midpoints; the paper has ten.
      spheres_per_link: Contact spheres of a link, only with `effects.surface = "spheres"`.
      hull_rings: Rings of a link, only with `effects.surface = "hull"`.
      hull_points: Vertices of a ring of the mesh that is drawn, a multiple of four.
      integrator: How springs and dampers are integrated: "newmark" is of second order and damps as
        the material does, "euler" adds the time step to the damping time; see docs/physics.md.
    """

    timestep: float = quantity("s", 1e-5, 0.05, structure=True)
    links: int = quantity("", 1, 200, structure=True)
    spheres_per_link: int = quantity("", 1, 20, structure=True)
    hull_rings: int = quantity("", 1, 20, structure=True, default=2)
    hull_points: int = quantity("", 4, 80, structure=True, default=8)
    integrator: str = choice("euler", "newmark", default="euler")


@dataclasses.dataclass(frozen=True)
class Solver:
    """MuJoCo's options of its contact solver, which the engines `mujoco` and `mjx` read.

    The engine `structured` measures convergence otherwise, see `Newton`. If the values are not
    those of an accuracy, it requires that `[newton]` is set as well.

    Attributes:
      iterations: Largest number of Newton iterations.
      ls_iterations: Largest number of line-search iterations. Where friction is 30 times as stiff
        as the normal direction 20 are too few: a search that ends early looks like convergence.
      tolerance: MuJoCo's tolerance: the improvement or gradient of the cost, scaled by the model's
        inertia. It must not be zero: MuJoCo's line search may then return no step at all.
    """

    iterations: int = quantity("", 1, 1000, structure=True, default=30)
    ls_iterations: int = quantity("", 1, 1000, structure=True, default=50)
    tolerance: float = quantity("", 1e-16, 1, structure=True, default=1e-8)


@dataclasses.dataclass(frozen=True)
class Newton:
    """Limits of the contact solver of the engine `structured`.

    Attributes:
      iterations: Largest number of Newton iterations of a step.
      evaluations: Largest number of line-search evaluations of an iteration. Without a kernel, a
        line search has at most six evaluations.
      decrement: Relative Newton decrement at which a world has converged, a share of the cost's
        scale. A step that ends above it has stopped at the limit of iterations.
      residual: A step that ends at the limit of iterations with a residual (root of its decrement)
        above this value gives the trial the warning SOLVER_CAP; see `Outcome`.
    """

    iterations: int = quantity("", 1, 1000, structure=True, default=24)
    evaluations: int = quantity("", 1, 1000, structure=True, default=14)
    decrement: float = quantity("", 1e-16, 1, structure=True, default=1e-3)
    residual: float = quantity("", 1e-8, 1e8, structure=True, default=0.01)


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """Values of an accuracy; docs/accuracy.md has its measured errors and cost.

    Attributes:
      description: What the accuracy is for.
      discretization: Values of the scene's table `[discretization]` that the accuracy replaces.
      solver: Values of the scene's table `[solver]` that the accuracy replaces.
      newton: Values of the scene's table `[newton]` that the accuracy replaces.
    """

    description: str
    discretization: dict[str, Any]
    solver: dict[str, Any]
    newton: dict[str, Any] = dataclasses.field(default_factory=dict)


@table
@dataclasses.dataclass(frozen=True)
class Limits:
    """Bounds beyond which a finite world has failed, and limits of what can be built.

    All but the first two limit the designs that a search proposes; they do not affect a simulation.
    Every proposal is projected onto them.  A key that is not given is no limit, and a preset of the
    hand with `limits = false` has Table I alone.

    Attributes:
      speed: Largest velocity of any joint.
      penetration: How far the object's centre may be below the table, if there is one, and any body
        in another at the start.
      strain: Largest strain of the walls of a free finger at its pressure; a higher pressure is
        lowered to meet it.
      free_bend: Largest bend of a free finger at its pressure; a higher pressure is lowered to meet
        it. More than a full turn is a coil.
      pressure_margin: Share by which pressures stay below the lowest of their limits, Table I's,
        `strain` and `free_bend`.
      finger_length: Least and largest length of a finger.
      finger_slenderness: Least length of a finger over the height of its section: a shorter one is
        a prop.
      arm_tilt: Largest roll and pitch of the arm.
      palm_clearance: Least height of the palm's rim over the table, as commanded; `arm_z` is
        raised.
      wrist_force: Largest force of the wrist's springs where the palm is commanded into the table
        or into the tallest object; `arm_z` is raised to meet it, because a stiff arm would stop
        there.
    """

    speed: float = quantity("rad/s or m/s", 1, 1e9)
    penetration: float = quantity("m", 1e-4, 1)
    strain: float | None = quantity("", 0.05, 10, structure=True, default=None)
    free_bend: float | None = quantity("deg", 10, 36000, structure=True, default=None)
    pressure_margin: float | None = quantity("", 0, 0.9, structure=True, default=None)
    finger_length: tuple[float, ...] | None = quantity("m", 0, 1, structure=True, default=None)
    finger_slenderness: float | None = quantity("", 0, 20, structure=True, default=None)
    arm_tilt: float | None = quantity("deg", 0, 180, structure=True, default=None)
    palm_clearance: float | None = quantity("m", -1, 1, structure=True, default=None)
    wrist_force: float | None = quantity("N", 0, 1e6, structure=True, default=None)

    @property
    def of_worlds(self) -> "Limits":
        """Without those of a search."""
        return Limits(self.speed, self.penetration)
