"""A rosbridge server for tests and the bench: an arm that follows goals, and its force sensor."""

import contextlib
import json
import threading
import time

import numpy as np

from limber.robot.ros.messages import spline

STEP = 0.008
_LARGEST_BYTES = 10_000_000  # rosbridge_server's own limit (parameter max_message_size)
_NAMES = [f"{name}_joint" for name in (
    "elbow", "shoulder_lift", "shoulder_pan", "wrist_1", "wrist_2", "wrist_3")]
_ORDER = [2, 1, 0, 3, 4, 5]  # of the arm's joints in those names


class RosBridge:
    """Serves on a free port; a context manager.

    Attributes:
        joints: Where the arm stands, in its own order [rad], shape [6].
        wrench: What the sensor tells besides noise [N, N m], shape [6].
        load: Returns more of that, from the joints.
        gripper_status: With which the gripper's action ends.
        stood_at: When the last goal was cancelled, and the arm stood [s, monotonic].
        heard: Operations that came, each with its time.
        silent: Topics that send nothing.
        drift: Speeds at which another program moves the arm [rad/s], shape [6].
        answers: Of services that a client offers.
        sent: Messages of topics that were sent: time of their step [s], topic, content.
    """

    def __init__(self, joints):
        self.joints, self.speeds = np.array(joints, float), np.zeros(6)
        self.wrench, self.heard, self.silent = np.zeros(6), [], set()
        self.followed, self.stood_at = [], None
        self.load = lambda joints: np.zeros(6)
        self.gripper_status = 4
        self.drift, self.answers, self.sent = np.zeros(6), [], []
        self._subscribed, self._offering = set(), None
        self._goal, self._open = None, []
        self._rng = np.random.default_rng(0)

    def __enter__(self):
        from websockets.sync.server import serve

        self._server = serve(self._serve, "127.0.0.1", 0, compression=None,
                             close_timeout=0.2, max_size=_LARGEST_BYTES)
        self.url = f"ws://127.0.0.1:{self._server.socket.getsockname()[1]}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_exception):
        for socket in self._open:
            socket.close()
        self._server.shutdown()

    def _serve(self, socket):
        from websockets.exceptions import ConnectionClosed

        self._open.append(socket)
        listening = threading.Thread(target=self._listen, args=(socket,), daemon=True)
        listening.start()
        # One that only offers a service is sent nothing, and does not step the arm.
        while listening.is_alive() and socket not in self._subscribed:
            time.sleep(STEP)
        began, count = time.monotonic(), 0
        try:
            while listening.is_alive():
                count += 1
                self._step(socket)
                self._send(socket, "/joint_states", count, {
                    "name": _NAMES, "position": self.joints[_ORDER].tolist(),
                    "velocity": self.speeds[_ORDER].tolist(), "effort": []})
                told = self.wrench + self.load(self.joints) + 0.02 * self._rng.standard_normal(6)
                self._send(socket, "/force_torque_sensor_broadcaster/wrench", count, {"wrench": {
                    kind: dict(zip("xyz", map(float, part), strict=True))
                    for kind, part in (("force", told[:3]), ("torque", told[3:]))}})
                time.sleep(max(began + count * STEP - time.monotonic(), 0.0))
        except ConnectionClosed:
            return

    def _send(self, socket, topic, count, message):
        if topic not in self.silent:
            seconds = count * STEP
            stamp = {"sec": int(seconds), "nanosec": round(1e9 * (seconds % 1))}
            message = {"header": {"stamp": stamp, "frame_id": ""}, **message}
            self.sent.append((seconds, topic, message))
            socket.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))

    def _step(self, socket):
        before = self.joints.copy()
        self.joints = self.joints + STEP * self.drift
        if self._goal is not None:
            goal, times, ways, speeds, at = self._goal
            at = min(at + STEP, times[-1])
            first = min(int(np.searchsorted(times, at, side="right")) - 1, len(times) - 2)
            ends = slice(first, first + 2)
            self.joints = spline(at, times[ends], ways[ends], speeds[ends])
            self.followed.append(self.joints.copy())
            self._goal = (goal, times, ways, speeds, at)
            if at >= times[-1]:
                self._goal = None
                socket.send(json.dumps({"op": "action_result", "id": goal["id"], "status": 4,
                                        "action": goal["action"], "values": {"error_code": 0},
                                        "result": True}))
        self.speeds = (self.joints - before) / STEP

    def _listen(self, socket):
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            for text in socket:
                order = json.loads(text)
                if order["op"] == "subscribe":
                    self._subscribed.add(socket)
                elif order["op"] == "advertise_service":
                    self._offering = socket
                elif order["op"] == "service_response":
                    self.answers.append(order)
                else:
                    self._hear(socket, order)

    def _hear(self, socket, order):
        self.heard.append((time.monotonic(), order))
        if order["op"] == "send_action_goal" and order["action_type"].endswith("GripperCommand"):
            socket.send(json.dumps({
                "op": "action_result", "id": order["id"], "action": order["action"],
                "status": self.gripper_status, "result": True, "values": {
                    "position": 0.31, "effort": 0.0, "stalled": True, "reached_goal": False}}))
        elif order["op"] == "send_action_goal":
            points = order["args"]["trajectory"]["points"]
            order_of = [order["args"]["trajectory"]["joint_names"].index(name) for name in _NAMES]
            ways, speeds = (np.array([point[kind] for point in points])[:, order_of][:, _ORDER]
                            for kind in ("positions", "velocities"))
            self._goal = (order, np.array([
                point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"]
                for point in points]), ways, speeds, 0.0)
        elif order["op"] == "cancel_action_goal":
            self._goal, self.stood_at = None, time.monotonic()

    def call_service(self, name, times):
        """Call a service that a client offers, as any node may; then hang up."""
        while self._offering is None:
            time.sleep(STEP)
        for number in range(times):
            self._offering.send(json.dumps({"op": "call_service", "id": f"call-{number}",
                                            "service": name, "args": {}}))
            while len(self.answers) <= number:
                time.sleep(STEP)
        offering, self._offering = self._offering, None
        offering.close()

    def publish(self, topic, message):
        """Publish a message to every client, as any node may."""
        for socket in self._open:
            socket.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))


class ReplayedBridge(RosBridge):
    """Sends recorded messages at their times to one client; its arm moves as it was recorded.

    Args:
        messages: Times [s], topics and contents, by time.
    """

    def __init__(self, messages):
        super().__init__(np.zeros(6))
        self._messages = messages

    def _serve(self, socket):
        from websockets.exceptions import ConnectionClosed

        self._open.append(socket)
        listening = threading.Thread(target=self._listen, args=(socket,), daemon=True)
        listening.start()
        begin, first = time.monotonic(), self._messages[0][0]
        with contextlib.suppress(ConnectionClosed):
            for seconds, topic, message in self._messages:
                time.sleep(max(begin + seconds - first - time.monotonic(), 0.0))
                socket.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))
            if self._goal is not None:
                goal = self._goal[0]
                socket.send(json.dumps({"op": "action_result", "id": goal["id"], "status": 4,
                                        "action": goal["action"], "values": {"error_code": 0},
                                        "result": True}))
        listening.join()
