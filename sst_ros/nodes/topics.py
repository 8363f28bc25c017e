# SPDX-License-Identifier: Apache-2.0
"""Every topic and service of every node, declared once: nodes open them, docs and tests list them.

In names ~ stands for the name of the node.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped, Vector3Stamped, WrenchStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from sst_ros.runtime.torque_input import MOST_WAITING

PUBLISHES, SUBSCRIBES, SERVES, CALLS = "publishes", "subscribes", "serves", "calls"
EXECUTES = "executes"

SERVICE_QOS = QoSProfile(depth=1000)
"""Of services and of our clients: with ten, the default, the eleventh request that waits displaces
the first, and so does the eleventh reply. All clients of a service receive all of its replies."""


@dataclass(frozen=True)
class Endpoint:
    """One topic or service of a node.

    Attributes:
        use: PUBLISHES, SUBSCRIBES, SERVES, CALLS or EXECUTES, the last of an action.
        name: its name; {simulator} stands for the player's parameter.
        kind: type of its messages; by name, where its package is in no wheel.
        doc: what it carries.
        depth: messages kept for slow readers; 0 for two seconds of them.
        latched: the last message is kept for late joiners.
        when: the condition under which it exists; always where empty.

    """

    use: str
    name: str
    kind: Any
    doc: str
    depth: int = 10
    latched: bool = False
    when: str = ""

    @property
    def type_name(self) -> str:
        """The type as ROS writes it."""
        if isinstance(self.kind, str):
            return self.kind
        package, form, *_ = self.kind.__module__.split(".")
        return f"{package}/{form}/{self.kind.__name__}"

    def at(self, node: str) -> str:
        """Return its full name at the node of this full name."""
        name = self.name.replace("~", node)
        return name if name.startswith("/") else f"{node.rpartition('/')[0]}/{name}"

    def publisher(self, node: Node, depth: int = 0, *, simulator: str = "") -> Publisher[Any]:
        """Create its publisher."""
        return node.create_publisher(self.kind, self.resolved(simulator), self._qos(depth))

    def subscription(
        self, node: Node, callback: Callable[[Any], None], *, simulator: str = ""
    ) -> Subscription[Any]:
        """Create its subscription."""
        return node.create_subscription(
            self.kind, self.resolved(simulator), callback, self._qos(self.depth)
        )

    def resolved(self, simulator: str) -> str:
        """Return its name with that of the simulator's node."""
        return self.name.replace("{simulator}", simulator)

    def _qos(self, depth: int) -> QoSProfile:
        durability = DurabilityPolicy.TRANSIENT_LOCAL if self.latched else DurabilityPolicy.VOLATILE
        return QoSProfile(depth=self.depth or depth, durability=durability)


JOINT_STATES = Endpoint(
    PUBLISHES,
    "joint_states",
    JointState,
    "gamma_1..3, mu_1..3, beta_1..3: position [rad], velocity [rad/s]; effort: torque over the "
    "step that ended [N m]; frame_id `idle` where it is no sample of a run",
    depth=0,
)
ORIENTATION = Endpoint(
    PUBLISHES,
    "~/orientation",
    QuaternionStamped,
    "orientation of {E} in {B}, frame_id `base_link`",
    depth=0,
)
EULER_ZYZ = Endpoint(
    PUBLISHES, "~/euler_zyz", Vector3Stamped, "the same as ZYZ angles theta, phi, psi [rad]", 0
)
APPLIED_TORQUES = Endpoint(
    PUBLISHES,
    "~/applied_torques",
    JointTrajectory,
    "torques of every step since the last message [N m], with the sample after 50 ms of simulated "
    "time and when the run pauses or ends; where the scene takes a moment from a topic also "
    "moment_x, moment_y, moment_z in {B}",
    depth=0,
)
SCENE = Endpoint(PUBLISHES, "~/scene", String, "the scene, as YAML", 1, latched=True)
PHASE = Endpoint(
    PUBLISHES,
    "~/phase",
    String,
    "waiting, running, paused, finished, or `fault: ` with the reason",
    depth=1,
    latched=True,
)
DIAGNOSTICS = Endpoint(
    PUBLISHES, "/diagnostics", DiagnosticArray, "diagnostics of the run, at 1 Hz"
)
CLOCK = Endpoint(
    PUBLISHES, "/clock", Clock, "simulated time", depth=1, when="publish_clock is true"
)
ROBOT_DESCRIPTION = Endpoint(
    PUBLISHES,
    "robot_description",
    String,
    "the scene as URDF",
    depth=1,
    latched=True,
    when="publish_description is true, the default",
)
COMMANDS = Endpoint(
    SUBSCRIBES,
    "~/commands",
    Float64MultiArray,
    "torques of gamma_1..3 [N m], held until the next",
    MOST_WAITING,
)
COMMANDS_STAMPED = Endpoint(
    SUBSCRIBES,
    "~/commands_stamped",
    JointState,
    "the same by name, in effort [N m]; the stamp is that of the joint_states it answers",
    MOST_WAITING,
)
EXTERNAL_MOMENT = Endpoint(
    SUBSCRIBES,
    "~/external_moment",
    WrenchStamped,
    "moment on the star, torque in {B} [N m]; the force is not used",
    MOST_WAITING,
    when="the scene has moment: {topic: true}",
)
SET_STATE = Endpoint(
    SUBSCRIBES,
    "~/set_state",
    JointState,
    "state to continue from: position [rad] and velocity [rad/s] (none for zero) of gamma_1..3; "
    "refused while running, in fault, and where it is not admissible",
)
PAUSE = Endpoint(SERVES, "~/pause", SetBool, "pause the run, or resume it; idempotent")
STEP = Endpoint(
    SERVES, "~/step", Trigger, "advance a paused run by one sample; refused while running"
)
RESET = Endpoint(
    SERVES, "~/reset", Trigger, "back to the initial state, also out of a fault; stamps continue"
)

SIMULATOR = (
    JOINT_STATES,
    ORIENTATION,
    EULER_ZYZ,
    APPLIED_TORQUES,
    SCENE,
    PHASE,
    DIAGNOSTICS,
    CLOCK,
    ROBOT_DESCRIPTION,
    COMMANDS,
    COMMANDS_STAMPED,
    EXTERNAL_MOMENT,
    SET_STATE,
    PAUSE,
    STEP,
    RESET,
)


def _torques(doc: str) -> tuple[Endpoint, Endpoint]:
    """Return the commands of a node whose parameter `stamped` selects one of them."""
    plain, stamped = "{simulator}/commands", "{simulator}/commands_stamped"
    same = "the same, by name and stamp"
    return (
        Endpoint(PUBLISHES, plain, Float64MultiArray, doc, when="stamped is false"),
        Endpoint(PUBLISHES, stamped, JointState, same, when="stamped is true"),
    )


PLAYED = Endpoint(
    SUBSCRIBES,
    "joint_states",
    JointState,
    "samples that are answered, from the first on",
    depth=1000,
)
PLAYER_PHASE = Endpoint(
    SUBSCRIBES, "{simulator}/phase", String, "ends the player at a fault", 1, True
)
PLAYER = (
    *_torques("the profile's torques [N m] for the hold that each joint_states begins"),
    PLAYED,
    PLAYER_PHASE,
)

VIEWED = tuple(
    Endpoint(SUBSCRIBES, *declared)
    for declared in (
        ("joint_states", JointState, "states that are shown", 64),
        ("{simulator}/scene", String, "manipulator that is drawn", 1, True),
        ("{simulator}/phase", String, "phase of the run", 1, True),
        ("/diagnostics", DiagnosticArray, "diagnostics of the run"),
    )
)
VIEWER_COMMANDS = Endpoint(
    PUBLISHES,
    "{simulator}/commands",
    Float64MultiArray,
    "torques of the page's sliders [N m], 20 times a second",
    when="a slider was moved and no other node publishes commands",
)
CALLED = tuple(
    Endpoint(CALLS, f"{{simulator}}/{name}", kind, doc)
    for name, kind, doc in (
        ("pause", SetBool, "the button Pause, or Resume"),
        ("step", Trigger, "the button Step"),
        ("reset", Trigger, "the button Reset"),
    )
)
VIEWER = (*VIEWED, VIEWER_COMMANDS, *CALLED)

REFERENCE = Endpoint(
    PUBLISHES,
    "~/reference",
    JointState,
    "desired gamma [rad] and gamma_dot [rad/s]; effort: feedforward [N m]; the stamp is that of "
    "the joint_states it belongs to",
    depth=1000,
)
TRACKING_ERROR = Endpoint(
    PUBLISHES,
    "~/tracking_error",
    JointState,
    "desired - measured [rad], [rad/s]; effort: feedback [N m]; stamp as of ~/reference",
    depth=1000,
)
JOINT_TRAJECTORY = Endpoint(
    SUBSCRIBES,
    "~/joint_trajectory",
    JointTrajectory,
    "motion to follow, from now on and in place of the present one; refused as a whole where it "
    "cannot be followed, and where motion is not topic",
)
FOLLOW_JOINT_TRAJECTORY = Endpoint(
    EXECUTES,
    "~/follow_joint_trajectory",
    "control_msgs/action/FollowJointTrajectory",
    "the same with tolerances, feedback and a result",
    when="control_msgs is installed",
)

CONTROLLED = Endpoint(
    SUBSCRIBES, "joint_states", JointState, "samples that are answered; the newest counts", 1
)
CONTROLLER_PHASE = Endpoint(
    SUBSCRIBES,
    "{simulator}/phase",
    String,
    "begins anew at a reset, ends at a fault and at the end of the run",
    10,
    True,
)
INVERSE_DYNAMICS = (
    *_torques("torques [N m] that answer each joint_states"),
    REFERENCE,
    TRACKING_ERROR,
    Endpoint(PUBLISHES, "/diagnostics", DiagnosticArray, "diagnostics of the control, at 1 Hz"),
    CONTROLLED,
    CONTROLLER_PHASE,
    JOINT_TRAJECTORY,
    FOLLOW_JOINT_TRAJECTORY,
)

RECORDER: tuple[Endpoint, ...] = ()
"""The recorder subscribes to the topics of its parameter `topics`, and to nothing else."""
