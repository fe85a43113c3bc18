"""A rosbridge server for tests and the bench: an arm that follows goals, and its force sensor."""

import contextlib
import json
import threading
import time

import numpy as np

from limber.robot.ros.messages import spline

STEP = 0.008
_PROGRAM = "/io_and_status_controller/robot_program_running"
_SCALING = "/speed_scaling_state_broadcaster/speed_scaling"
_SUCCEEDED, _CANCELED = 4, 5  # action_msgs/msg/GoalStatus
_LARGEST_BYTES = 10_000_000  # rosbridge_server's own limit (parameter max_message_size)
_NAMES = [f"{name}_joint" for name in (
    "elbow", "shoulder_lift", "shoulder_pan", "wrist_1", "wrist_2", "wrist_3")]
_ORDER = [2, 1, 0, 3, 4, 5]  # of the arm's joints in those names


class RosBridge:
    """Serves on a free port; a context manager.

    Attributes:
        joints: Where the arm stands, in its own order [rad], shape [6].
        wrench: What the sensor tells besides noise [N, N m], shape [6].
        wrench_topic: Where it tells it.
        load: Returns more of that, from the joints.
        gripped: Called with the position that a gripper is sent to.
        payload: Set in the controller [kg].
        clock_ahead: Of the stamps [s].
        stood_at: When the last goal ended, and the arm stood [s, monotonic].
        heard: Operations that came, each with its time.
        silent: Topics that send nothing.
        drift: Speeds at which another program moves the arm [rad/s], shape [6].
        answers: Of services that a client offers.
        sent: Joint states and wrenches that were sent: time of their step [s], topic, content.
        status: What the UR driver publishes of its controller, by topic: at a subscription and
            when it changes.
        others: Messages that another node publishes on /joint_states in each step.
        has_arm: Whether the arm's own are published there.
        sticks: The arm stands whatever its goal, and nothing reports why.
        accepts_after: Steps before the controller accepts a goal; until then a cancel is lost.
        speed_noise: Of joint states [rad/s].
        prefix: Of the names of its joints.
        space: Name space of all but the joint states.
    """

    def __init__(self, joints):
        self.joints, self.speeds = np.array(joints, float), np.zeros(6)
        self.wrench, self.heard, self.silent = np.zeros(6), [], set()
        self.wrench_topic = "/force_torque_sensor_broadcaster/wrench"
        self.followed, self.stood_at, self.load = [], None, lambda joints: np.zeros(6)
        self.drift, self.answers, self.sent = np.zeros(6), [], []
        self.status = {"/io_and_status_controller/safety_mode": {"mode": 1},
                       "/io_and_status_controller/robot_mode": {"mode": 7},
                       _PROGRAM: {"data": True}, _SCALING: {"data": 100.0}}
        self.others, self.has_arm, self.sticks = [], True, False
        self.accepts_after = 0
        self.speed_noise, self.prefix, self.space = 0.0, "", ""
        self.gripped, self.payload, self.clock_ahead = lambda position: None, 0.0, 0.0
        self._subscribed, self._offering = {}, None
        self._goal, self._open, self._age, self._lock = None, [], 0, threading.Lock()
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
        began, count, told = time.monotonic(), 0, {}
        with contextlib.suppress(ConnectionClosed):
            while listening.is_alive():
                count += 1
                self.turn(socket, count, told)
                time.sleep(max(began + count * STEP - time.monotonic(), 0.0))

    def turn(self, socket, count, told):
        """Step the arm for the ``count``-th time, and send all that is published then.

        Args:
            told: What was last sent to this client of the status, by topic; updated.
        """
        with self._lock:
            self._step(socket)
        self._send_status(socket, told)
        for other in self.others:
            self._send(socket, "/joint_states", count, other)
        if self.has_arm:
            self._send(socket, "/joint_states", count, {
                "name": [self.prefix + name for name in _NAMES],
                "position": self.joints[_ORDER].tolist(), "effort": [],
                "velocity": (self.speeds[_ORDER] + self.speed_noise
                             * self._rng.standard_normal(6)).tolist()})
        felt = self.wrench + self.load(self.joints) + 0.02 * self._rng.standard_normal(6)
        self._send(socket, self.space + self.wrench_topic, count, {"wrench": {
            kind: dict(zip("xyz", map(float, part), strict=True))
            for kind, part in (("force", felt[:3]), ("torque", felt[3:]))}})

    def _send(self, socket, topic, count, message):
        if topic not in self.silent:
            now = count * STEP + self.clock_ahead
            stamp = {"sec": int(now), "nanosec": round(1e9 * (now % 1))}
            message = {"header": {"stamp": stamp, "frame_id": ""}, **message}
            self.sent.append((count * STEP, topic, message))
            socket.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))

    def _send_status(self, socket, told):
        """Send what has changed since ``told``, and the scaling always."""
        for topic, message in self.status.items():
            if self.space + topic in self._subscribed.get(socket, ()) and (
                    topic not in self.silent) and (
                    topic == _SCALING or told.get(topic) != message):
                told[topic] = message
                socket.send(json.dumps({"op": "publish", "topic": self.space + topic,
                                        "msg": message}))

    @property
    def is_busy(self):
        """Whether a goal runs."""
        return self._goal is not None

    @property
    def _pace(self):
        """Of the goal's time: the controller scales it, and stands without its program."""
        runs = self.status[_PROGRAM]["data"] and not self.sticks
        return 0.01 * (self.status[_SCALING]["data"] or 0.0) if runs else 0.0

    def _step(self, socket):
        before = self.joints.copy()
        self.joints = self.joints + STEP * self.drift
        self._age += 1
        if self._goal is not None and self._age > self.accepts_after:
            order, times, ways, speeds, at = self._goal
            at = min(at + STEP * self._pace, times[-1])
            first = min(int(np.searchsorted(times, at, side="right")) - 1, len(times) - 2)
            ends = slice(first, first + 2)
            self.joints = spline(at, times[ends], ways[ends], speeds[ends])
            self.followed.append(self.joints.copy())
            self._goal = (order, times, ways, speeds, at)
            if at >= times[-1]:
                self.end_goal(socket, _SUCCEEDED, error_code=0)
        self.speeds = (self.joints - before) / STEP

    def _listen(self, socket):
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            for text in socket:
                self.obey(socket, json.loads(text))

    def obey(self, socket, order):
        """Carry out an operation of a client."""
        if order["op"] == "subscribe":
            self._subscribed.setdefault(socket, set()).add(order["topic"])
        elif order["op"] == "advertise_service":
            self._offering = socket
        elif order["op"] == "service_response":
            self.answers.append(order)
        else:
            with self._lock:
                self._hear(socket, order)

    def end_goal(self, socket, status, **values):
        """End the running goal with a status, as its controller decides."""
        goal, self._goal, self.stood_at = self._goal[0], None, time.monotonic()
        socket.send(json.dumps({"op": "action_result", "id": goal["id"], "status": status,
                                "action": goal["action"], "values": values, "result": True}))

    def _hear(self, socket, order):
        from websockets.exceptions import ConnectionClosed

        self.heard.append((time.monotonic(), order))
        if order["op"] == "send_action_goal" and order["action_type"].endswith("Trajectory"):
            points = order["args"]["trajectory"]["points"]
            order_of = [order["args"]["trajectory"]["joint_names"].index(self.prefix + name)
                        for name in _NAMES]
            ways, speeds = (np.array([point[kind] for point in points])[:, order_of][:, _ORDER]
                            for kind in ("positions", "velocities"))
            self._goal = (order, np.array([
                point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"]
                for point in points]), ways, speeds, 0.0)
            self._age = 0
        elif order["op"] == "send_action_goal":
            self.gripped(order["args"]["command"]["position"])
        elif order["op"] == "call_service":
            self.payload = order["args"]["mass"]
            socket.send(json.dumps({
                "op": "service_response", "id": order["id"], "service": order["service"],
                "values": {"success": True}, "result": True}))
        elif order["op"] == "publish":
            # Who publishes hears it too.
            for each, topics in list(self._subscribed.items()):
                if order["topic"] in topics - self.silent:
                    with contextlib.suppress(ConnectionClosed):
                        each.send(json.dumps(order))
        elif order["op"] == "cancel_action_goal" and self._goal is not None and (
                self._age >= self.accepts_after):
            self.end_goal(socket, _CANCELED)

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
