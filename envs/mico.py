"""A 6-joint arm lifts a payload whose mass it does not know: Kinova's Mico, after the thesis proposal's Sec. 3.4.3.

The arm is mico_arm.py's. The payload is a point mass at the end effector and a part of the rigid body that MuJoCo
moves, so that its weight and its inertia both act: there is one compiled model for each mass (payload_models.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar
from xml.etree import ElementTree

import numpy as np
from array_api_compat import array_namespace
from numpy.typing import NDArray

from beliefgym.envs.mico_arm import BASE_MASS, EFFORTS, LINKS, TIP, Six
from beliefgym.envs.mujoco_system import MujocoSystem
from beliefgym.envs.payload_models import PayloadModels
from beliefgym.envs.serial_arm import mjcf
from beliefgym.envs.system import Array

if TYPE_CHECKING:
    from beliefgym.envs.random_streams import RandomStreams
    from beliefgym.envs.rendering import Canvas

Floats = NDArray[np.float64]


def _names(stem: str) -> tuple[str, ...]:
    return tuple(f"{stem}_{i}" for i in range(1, 7))


@dataclass(frozen=True, kw_only=True)
class MicoLift(MujocoSystem):
    """Lift a payload of unknown mass and hold it: a moving 6-joint arm, read by its angles and motor torques.

    As on the real robot, the motors' torques come from an inner position controller that knows the arm's own
    weight g_0(q), but not the payload's. The arm is to follow r(t); the action u moves the controller's reference:

        tau = K (r(t) + u - q) + D (dr/dt - dq/dt) + g_0(q),        within the motors' limits,
        r(t) = start + lift p((t - grasp_time) / lift_time),        p(x) = 10 x^3 - 15 x^4 + 6 x^5 on 0..1.

    So a load shows in the torques, and in the arm's sag: without an action the arm hangs K^-1 J' m g below r. The
    action that the task asks for is, but for the inertia, u = K^-1 J(q)' m g: whoever finds the mass m in the
    torques can lift exactly, and needs to know no reference. Were the torques the agent's own actions, there would
    be nothing to read in them.

    The payload stands on a support until grasp_time; then the gripper takes it where the hand is, at the hand's
    speed, and the arm lifts. Until then nothing tells the mass (thesis: "the robot starts moving at approximately
    the halfway point", and that is when information comes). From then on its weight and inertia act.

    | #      | state                      | unit  |   | #      | observation                    | range          |
    |--------|----------------------------|-------|---|--------|--------------------------------|----------------|
    | 0..5   | joint_1, joint_2, joint_3, | rad   |   | 0..5   | joint_1 .. joint_6             | unbounded      |
    |        | joint_4, joint_5, joint_6  |       |   | 6..11  | torque_1 .. torque_6           | -effort..effort|
    | 6..11  | velocity_1, velocity_2,    | rad/s |   | 12..17 | velocity_1 .. velocity_6       | unbounded      |
    |        | velocity_3, velocity_4,    |       |   | 18     | payload_mass                   | 0..inf kg      |
    |        | velocity_5, velocity_6     |       |   | 19     | time                           | unbounded      |
    | 12..17 | torque_1, torque_2,        | N m   |   | 20..25 | reference_1, reference_2,      | unbounded      |
    |        | torque_3, torque_4,        |       |   |        | reference_3, reference_4,      |                |
    |        | torque_5, torque_6         |       |   |        | reference_5, reference_6 = r(t)|                |
    | 18     | payload_mass               | kg    |   |        |                                |                |
    | 19     | time                       | s     |   | #      | action                         | range (rad)    |
    | 20..25 | start_1, start_2, start_3, | rad   |   | 0..5   | offset_1, offset_2, offset_3,  | -0.15..0.15    |
    |        | start_4, start_5, start_6  |       |   |        | offset_4, offset_5, offset_6   |                |

    torque_i is what motor i gave in the last substep. The hint is payload_mass, in kg.

    Reward, in 0..1, of the state reached, with e = q - r: 1 / (1 + e'e / tolerance^2).
    Start: at rest at `start`, each joint uniform within +-start_spread of `pose`; the mass uniform in lightest..
    heaviest. `reset(options={"state": ...})` takes masses of 0.001..2 kg. End: after 160 steps (8 s).
    Versions: v0, the first. `beliefgym/MicoLiftTorque-v0` shows the angles and the torques only, the thesis's
    observations: of one instant, the angles do not tell the mass, angles and torques of an arm at rest do.
    `beliefgym/MicoLiftTorqueNoisy-v0` adds noise of 0.002 rad and 0.3 N m (chosen here): then the mass is known only
    after a while.

    Chosen here (the thesis and the robot's description do not say): dt, the 10 ms of the inner controller, the times
    (grasp_time=4 puts the start of the lift at half of the episode), the poses and their spread, the gains, the
    motors' reflected inertia `armature` (the description has damping, friction and armature of 0, which would leave
    0.0006 kg m^2 at the last joint), that gravity compensation knows the fingers, the fingers as one cylinder, the
    reward, and the noise: actuation_noise_std = 0.002 rad on the offsets (0.06 N m at the shoulder), drawn for each
    period. A mass that noise or a guess makes negative counts as 0.

    Args:
        lightest, heaviest: kg, of the drawn masses.
        grasp_time: s. lift_time: s; r(t) stays within 0.72 of the rated speeds. pose: rad, middle of the start poses.
        lift: rad, from the start pose to the raised one. start_spread: rad.
        stiffness: K in N m/rad. damping: D in N m s/rad. armature: kg m^2. max_offset: rad, of the action.
        gravity: m/s^2. tolerance: rad, the |e| at which the reward is 1/2.

    Raises:
        ValueError: a parameter out of its range, or a lift faster than the joints' rated speeds.

    Reference: thesis proposal, Sec. 3.4.3 (mass estimation from a robot manipulator); Venkatraman et al. 2016.
    """

    dt: float = 0.05
    substeps: int = 5
    actuation_noise_std: float | tuple[float, ...] = 0.002
    lightest: float = 0.045
    heaviest: float = 0.355
    grasp_time: float = 3.0
    lift_time: float = 2.5
    pose: Six = (0.3, 1.95, 4.5, 0.0, 0.0, 0.0)
    lift: Six = (-0.6, 0.6, -0.5, 0.4, -0.5, 0.6)
    start_spread: float = 0.15
    stiffness: Six = (30.0, 30.0, 20.0, 8.0, 8.0, 8.0)
    damping: Six = (7.0, 7.0, 4.0, 1.0, 1.0, 1.0)
    armature: float = 0.02
    max_offset: float = 0.15
    gravity: float = 9.81
    tolerance: float = 0.03

    state_names: ClassVar = (
        *_names("joint"),
        *_names("velocity"),
        *_names("torque"),
        "payload_mass",
        "time",
        *_names("start"),
    )
    action_names: ClassVar = _names("offset")
    observation_names: ClassVar = (
        *_names("joint"),
        *_names("torque"),
        *_names("velocity"),
        "payload_mass",
        "time",
        *_names("reference"),
    )
    hint_names: ClassVar = ("payload_mass",)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("pose", "lift", "stiffness", "damping"):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != 6:
                raise ValueError(f"expected {name} as 6 numbers, one a joint, got {len(values)}")
            object.__setattr__(self, name, values)
        for name in ("lift_time", "max_offset", "tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"expected {name} above 0, got {getattr(self, name)!r}")
        if not (min(self.stiffness) > 0 and min(self.damping) >= 0 and self.armature >= 0):
            raise ValueError("expected stiffness above 0, damping and armature of at least 0")
        if not POSSIBLE_MASS[0] <= self.lightest <= self.heaviest <= POSSIBLE_MASS[1]:
            raise ValueError(
                f"expected {POSSIBLE_MASS[0]:g} <= lightest <= heaviest <= {POSSIBLE_MASS[1]:g} kg, got "
                f"{self.lightest!r} and {self.heaviest!r}"
            )
        low, high = (limit[20:] for limit in self.state_limits)
        spread = self.start_spread
        for i, middle in enumerate(self.pose):
            if not low[i] <= middle - spread <= middle + spread <= high[i]:
                raise ValueError(
                    f"expected every start of {LINKS[i].joint} within {low[i]:.3g}..{high[i]:.3g} rad, so that start "
                    f"and raised pose are in its range, got {middle:g} +- {spread:g}"
                )
        fastest = 1.875 * np.abs(self.lift) / self.lift_time  # p'(1/2) = 15/8
        for item, speed in zip(LINKS, fastest, strict=True):
            if speed > item.velocity:
                raise ValueError(
                    f"expected a lift within the rated speed of {item.joint}, {item.velocity:.3g} rad/s, got "
                    f"{speed:.3g} rad/s; make lift_time longer or the lift smaller"
                )

    @property
    def action_limits(self) -> tuple[Floats, Floats]:
        """Offsets in rad."""
        high = np.full(6, self.max_offset)
        return -high, high

    @property
    def observation_limits(self) -> tuple[Floats, Floats]:
        """Torques within the motors' limits, the mass at least 0."""
        high = np.full(26, np.inf)
        high[6:12] = EFFORTS
        low = -high
        low[18] = 0.0
        return low, high

    @property
    def state_limits(self) -> tuple[Floats, Floats]:
        """Joints (and the reference's ends) within their ranges, torques within the efforts, masses of a payload."""
        low, high = np.full(26, -np.inf), np.full(26, np.inf)
        ends = np.array([(item.low, item.high) for item in LINKS]).T
        raised = np.array(self.lift)
        low[:6], high[:6] = ends
        low[12:18], high[12:18] = -EFFORTS, EFFORTS
        low[18], high[18] = POSSIBLE_MASS
        low[20:], high[20:] = ends[0] - np.minimum(raised, 0.0), ends[1] - np.maximum(raised, 0.0)
        return low, high

    def mjcf(self) -> str:
        """See `MujocoSystem.mjcf`: position servos, gravity compensation of the arm, and a payload without mass."""
        return mjcf(
            "mico", LINKS, TIP, armature=self.armature, gravity=self.gravity, extra=self._servos_and_payload
        )

    def _servos_and_payload(self, root: ElementTree.Element) -> None:
        base = _the(root, ".//body[@name='base']")
        inertial = {"pos": "0 0 0.08", "mass": repr(BASE_MASS), "diaginertia": "0.001 0.001 0.001"}
        ElementTree.SubElement(base, "inertial", inertial)
        for body in root.iter("body"):
            body.set("gravcomp", "1")
        payload = ElementTree.SubElement(_the(root, ".//body[@name='hand']"), "body", name="payload")
        ElementTree.SubElement(payload, "inertial", pos="0 0 0", mass="0", diaginertia="0 0 0")
        sensors = ElementTree.SubElement(root, "sensor")
        for item, k, d in zip(LINKS, self.stiffness, self.damping, strict=True):
            joint, motor = (_the(root, f".//{kind}[@name='{item.joint}']") for kind in ("joint", "motor"))
            joint.set("actuatorgravcomp", "true")
            joint.set("actuatorfrclimited", "true")
            joint.set("actuatorfrcrange", f"{-item.effort} {item.effort}")
            motor.tag = "position"
            motor.set("kp", repr(k))
            motor.set("kv", repr(d))
            del motor.attrib["ctrlrange"]
            ElementTree.SubElement(sensors, "jointactuatorfrc", joint=item.joint)

    def loaded_models(self, masses: Floats) -> list[Any]:
        """A compiled model for each mass (n,) in kg; the same object for the same mass. Shared: do not change them."""
        return _payload_models(self).of(masses)

    def carries(self, time: Array) -> Array:
        """Whether the gripper holds the payload in the period that begins at a time (...) in s; bool (...)."""
        return time > self.grasp_time - 0.5 * self.dt

    def advance(self, state: Floats, action: Floats) -> Floats:
        """See `MujocoSystem.advance`."""
        time, start = state[..., 19], state[..., 20:26]
        mass = np.where(self.carries(time) & (state[..., 18] > 0.0), state[..., 18], 0.0)
        instants = time[..., None] + np.arange(self.substeps) * (self.dt / self.substeps)
        r, speed, _ = self.reference(instants, start[..., None, :])
        lead = np.array(self.damping) / np.array(self.stiffness)
        control = r + lead * speed + action[..., None, :]
        motion, torque = self.simulate_and_sense(
            state[..., :12], control, self.loaded_models(mass.reshape(-1))
        )
        return np.concatenate(
            [motion, torque, state[..., 18:19], state[..., 19:20] + self.dt, state[..., 20:]], axis=-1
        )

    def reference(self, time: Array, start: Array) -> tuple[Array, Array, Array]:
        """What the arm is to follow, r(t) and its derivatives.

        Args:
            time: (...) s. start: (..., 6) rad.

        Returns:
            angles in rad, velocities in rad/s and accelerations in rad/s^2, each (..., 6).
        """
        xp = array_namespace(time, start)
        x = (time - self.grasp_time) / self.lift_time
        x = xp.where(x > 0.0, x, 0.0 * x)
        x = xp.where(x < 1.0, x, 0.0 * x + 1.0)
        p = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        p1 = 30.0 * x * x * (1.0 - x) * (1.0 - x) / self.lift_time
        p2 = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / self.lift_time**2
        angles = xp.stack([start[..., i] + p * rise for i, rise in enumerate(self.lift)], axis=-1)
        speeds = xp.stack([p1 * rise for rise in self.lift], axis=-1)
        return angles, speeds, xp.stack([p2 * rise for rise in self.lift], axis=-1)

    def tracking_error(self, state: Array) -> Array:
        """q - r(t), (..., 26) -> (..., 6) in rad."""
        return state[..., :6] - self.reference(state[..., 19], state[..., 20:26])[0]

    def project(self, state: Array) -> Array:
        """See `System.project`: a mass is at least 0."""
        xp = array_namespace(state)
        mass = state[..., 18:19]
        return xp.concat([state[..., :18], xp.where(mass > 0.0, mass, 0.0 * mass), state[..., 19:]], axis=-1)

    def hint(self, state: Array) -> Array:
        """The payload's mass, (..., 1) in kg."""
        return state[..., 18:19]

    def observe(self, state: Array) -> Array:
        """Angles, torques, velocities, mass, time, reference."""
        xp = array_namespace(state)
        r, _, _ = self.reference(state[..., 19], state[..., 20:26])
        return xp.concat([state[..., :6], state[..., 12:18], state[..., 6:12], state[..., 18:20], r], axis=-1)

    def reward(self, state: Array, action: Array, next_state: Array) -> Array:
        """How near the arm is to its reference; in 0..1; see the class."""
        return 1.0 / (1.0 + self._lag(next_state))

    def stage_cost(self, state: Array, action: Array) -> Array:
        """e'e / tolerance^2 + u'u / (100 max_offset^2)."""
        xp = array_namespace(state)
        return self._lag(state) + xp.sum(action * action, axis=-1) * (0.01 / self.max_offset**2)

    def _lag(self, state: Array) -> Array:
        error = self.tracking_error(state)
        return array_namespace(state).sum(error * error, axis=-1) * (1.0 / self.tolerance**2)

    def initial_state(self, streams: RandomStreams, mask: NDArray[np.bool_] | None = None) -> Floats:
        """At rest at a drawn pose with a drawn mass; the torques hold the arm's own weight."""
        drawn = streams.uniform(7, mask)
        start = np.array(self.pose) + (2.0 * drawn[:, :6] - 1.0) * self.start_spread
        mass = self.lightest + drawn[:, 6:] * (self.heaviest - self.lightest)
        at_rest = np.concatenate([start, np.zeros_like(start)], axis=1)
        torque = self.simulate_and_sense(at_rest, start)[1]
        return np.concatenate([at_rest, torque, mass, np.zeros_like(mass), start], axis=1)

    def expert(self) -> Any:
        """Inverse dynamics of the loaded arm along the reference, as offsets."""
        from beliefgym.envs.planning.mico import mico_expert

        return mico_expert(self)

    def draw(self, canvas: Canvas, state: Floats, action: Floats | None) -> None:
        """The arm, its payload (its area grows with the mass), and where the arm should be as a ghost."""
        from beliefgym.envs.mico_picture import draw_mico

        draw_mico(self, canvas, state)


POSSIBLE_MASS = (0.001, 2.0)  # kg


@lru_cache(maxsize=8)
def _payload_models(system: MicoLift) -> PayloadModels:
    return PayloadModels(system.model)


def _the(root: ElementTree.Element, path: str) -> ElementTree.Element:
    element = root.find(path)
    assert element is not None, path
    return element
