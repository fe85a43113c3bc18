"""A node beside the controller that stops the arm when Limber says so, or says nothing more."""

import rclpy
from action_msgs.srv import CancelGoal
from rclpy.node import Node
from std_msgs.msg import Bool, Empty
from std_srvs.srv import SetBool

from limber_stop.watch import Watch

ACTION = "/scaled_joint_trajectory_controller/follow_joint_trajectory"


class StopNode(Node):
    """Cancels all goals of the trajectory controller; a cancelled one holds where it is. With the
    parameter ``servo``, such as /servo_node, it pauses MoveIt Servo instead; a person goes on."""

    def __init__(self):
        super().__init__("limber_stop")
        action = self.declare_parameter("action", ACTION).value
        topic = self.declare_parameter("topic", "/limber/stop").value
        end = self.declare_parameter("end", "/limber/end").value
        self._watch = Watch()
        servo = self.declare_parameter("servo", "").value
        self._order = SetBool.Request(data=True) if servo else CancelGoal.Request()
        self._client = self.create_client(
            SetBool if servo else CancelGoal,
            f"{servo}/pause_servo" if servo else f"{action}/_action/cancel_goal")
        self.create_subscription(Bool, topic, self._heard, 10)
        self.create_subscription(Empty, end, lambda _: self._watch.ended(), 10)
        self.create_timer(0.02, self._look)

    def _now(self):
        return self.get_clock().now().nanoseconds * 1e-9

    def _heard(self, message):
        if self._watch.heard(message.data, self._now()):
            self._stop("a stop was published")

    def _look(self):
        if self._watch.is_silent(self._now()):
            self._stop("Limber fell silent")

    def _stop(self, why):
        self.get_logger().error(f"stopped: {why}")
        # A request of zeros cancels all goals (action_msgs/srv/CancelGoal).
        self._client.call_async(self._order)


def main():
    """Run the node."""
    rclpy.init()
    rclpy.spin(StopNode())


if __name__ == "__main__":
    main()
