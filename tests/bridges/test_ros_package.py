"""The ROS 2 package, without ROS: what its files say of each other, and its nodes on stand-ins.

The stand-ins for rclpy and launch are NO proof that anything works inside ROS. They take the calls
that their author found in rclpy's and launch's sources, and show in which order they come.
"""

from __future__ import annotations

import ast
import configparser
import importlib
import os
import re
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from bridges.ros2.emrld_bridge.emrld_bridge.parameters import as_text, config_of, parameters
from bridges.run_settings import RunConfig
from bridges.settings import SettingError
from emrld_jax.runs.usage import leaves

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "bridges" / "ros2" / "emrld_bridge"
MODULES = "bridges.ros2.emrld_bridge.emrld_bridge"


# what the files say


def test_package_xml_is_of_format_3() -> None:
    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    tags = [child.tag for child in root]

    assert (root.tag, root.get("format")) == ("package", "3")
    assert all(tags.count(tag) == 1 for tag in ("name", "version", "description", "export"))
    assert {"maintainer", "license"} <= set(tags)
    assert re.fullmatch(r"\d+\.\d+\.\d+", text(root, "version"))
    assert re.fullmatch(r"[^@ ]+@[^@ ]+\.[a-z]+", root.find("maintainer").get("email"))  # type: ignore[union-attr, arg-type]
    assert text(root, "export/build_type") == "ament_python"
    depends = [child.text for child in root.findall("exec_depend")]
    assert depends == sorted(set(depends), key=str)


def test_the_files_name_one_package_and_one_version() -> None:
    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    config = configparser.ConfigParser()
    config.read(PACKAGE / "setup.cfg")
    made = set_up()

    assert made["name"] == text(root, "name") == "emrld_bridge"
    assert made["version"] == text(root, "version")
    assert made["license"] == text(root, "license")
    assert (PACKAGE / "resource" / made["name"]).is_file()
    for section, option in (("develop", "script_dir"), ("install", "install_scripts")):
        assert config[section][option] == f"$base/lib/{made['name']}"


def test_all_that_is_installed_is_there() -> None:
    made = set_up()
    files = {file for _, files in made["data_files"] for file in files}

    assert all((PACKAGE / file).is_file() for file in files)
    assert {file.name for file in (PACKAGE / "launch").iterdir() if file.is_file()} == {
        Path(file).name for file in files if file.startswith("launch/")
    }
    for script in made["entry_points"]["console_scripts"]:
        name, module, function = re.fullmatch(r"(\w+) = ([\w.]+):(\w+)", script).groups()  # type: ignore[union-attr]
        source = PACKAGE / f"{module.replace('.', '/')}.py"
        assert f"\ndef {function}(" in source.read_text()
        assert f"`{name}`" in (PACKAGE / "README.md").read_text()


def test_the_file_of_parameters_is_what_the_node_declares() -> None:
    lines = (PACKAGE / "config" / "parameters.yaml").read_text()
    told = yaml.safe_load(lines)["/**"]["ros__parameters"]
    flat = {k: v for k, v in told.items() if k != "link"}
    flat |= {f"link.{k}": v for k, v in told["link"].items()}

    assert flat == {p.name: p.default for p in parameters()}
    assert all(type(flat[p.name]) is type(p.default) for p in parameters())
    comments = " ".join(re.findall(r"# (.*)", lines))
    missing = [p.name for p in parameters() if p.description not in comments]
    assert missing == []


def test_parameters_are_the_settings_that_mean_something_to_ros() -> None:
    names = {p.name for p in parameters()}

    assert {"bundle", "mode", "watchdog", "yes", "link.namespace"} <= names
    assert set(leaves(RunConfig())) - names == {
        *("robot", "link.domain_id", "link.peers", "link.interface"),
        *(name for name in leaves(RunConfig()) if name.startswith("sim.")),
    }


def test_the_defaults_are_those_of_bridges_run() -> None:
    assert config_of({p.name: p.default for p in parameters()}) == RunConfig(robot="rclpy")


@pytest.mark.parametrize(
    ("name", "value", "meant"),
    [
        ("watchdog", 1, 1.0),  # as people write it
        ("episodes", 7, 7),
        ("episodes", "7", 7),  # as the launch file passes it on
        ("yes", True, True),
        ("yes", "true", True),
        ("bundle", "a b/p.safetensors", "a b/p.safetensors"),
        ("recordings", ["one", "two"], ["one", "two"]),
        ("recordings", "[]", []),
    ],
)
def test_parameters_are_read(name: str, value: Any, meant: Any) -> None:
    assert getattr(config_of({name: value}), name) == meant


def test_wrong_parameters_are_refused() -> None:
    with pytest.raises(SettingError, match="episodes=0 is not allowed: it must be at least 1"):
        config_of({"episodes": 0})
    assert as_text([1.5, 2.0]) == "[1.5, 2.0]"


# the launch file


class Recorded:
    """Stands for any action of launch: it keeps what it was made with."""

    def __init__(self, kind: str, *arguments: Any, **values: Any) -> None:
        self.kind, self.arguments, self.values = kind, arguments, values

    def perform(self, context: dict[str, str]) -> str:
        """As a LaunchConfiguration."""
        return context[self.arguments[0]]


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The launch file's names, on stand-ins for what it imports."""

    def module(name: str, *names: str) -> None:
        made = ModuleType(name)
        for item in names:
            setattr(made, item, lambda *a, _kind=item, **k: Recorded(_kind, *a, **k))
        monkeypatch.setitem(sys.modules, name, made)

    module("launch", "LaunchContext", "LaunchDescription")
    module("launch.actions", "DeclareLaunchArgument", "OpaqueFunction", "Shutdown")
    module("launch.substitutions", "LaunchConfiguration")
    module("launch_ros")
    module("launch_ros.actions", "Node")
    module("launch_ros.parameter_descriptions", "ParameterValue")
    module("ament_index_python")
    module("ament_index_python.packages")
    vars(sys.modules["ament_index_python.packages"])["get_package_share_directory"] = share
    return runpy.run_path(str(PACKAGE / "launch" / "turtlebot3.launch.py"))


def share(package: str) -> str:
    assert package == "emrld_bridge"
    return str(PACKAGE)  # where the folder of the workspace has the same inside


def test_the_launch_file_declares_what_the_readme_lists(launch_file: dict[str, Any]) -> None:
    actions = launch_file["generate_launch_description"]().arguments[0]
    declared = {a.arguments[0]: a.values for a in actions if a.kind == "DeclareLaunchArgument"}
    readme = (PACKAGE / "README.md").read_text()
    listed = dict(re.findall(r"^\| `(\w+)` \|\s*(?:`([\w.]+)`)?\s*\|", readme, re.M))

    assert {k: v or None for k, v in listed.items()} == {
        **dict.fromkeys(declared),
        **{name: parameter for name, parameter, _ in launch_file["ARGUMENTS"]},
    }
    assert all(values["description"] for values in declared.values())
    assert Path(declared["parameters"]["default_value"]).is_file()
    assert set(listed.values()) - {""} <= {p.name for p in parameters()}


def test_only_what_is_given_overrides_the_file(launch_file: dict[str, Any]) -> None:
    arguments = {name: "" for name, _, _ in launch_file["ARGUMENTS"]}
    (bare,) = launch_file["_start"](arguments)
    (node,) = launch_file["_start"]({**arguments, "namespace": "lab", "bundle": "p.safetensors"})

    assert [p.arguments for p in bare.values["parameters"]] == [("parameters",)]
    file, given = node.values["parameters"]
    assert file.arguments == ("parameters",)
    assert set(given) == {"link.namespace", "bundle"}
    assert given["bundle"].values == {"value_type": str}
    assert (node.values["package"], node.values["executable"]) == ("emrld_bridge", "run")
    assert "name" not in node.values
    assert node.values["remappings"][0][0] == "cmd_vel"


# the nodes, on a stand-in for rclpy


class Ros:
    """What is asked of rclpy is written down; parameters may be overridden."""

    def __init__(self) -> None:
        self.calls: list[Any] = []
        self.overrides: dict[str, Any] = {}
        self.listeners: list[str] = []  # types that somebody listens to cmd_vel as
        self.published: list[Any] = []
        self.now: list[Any] = []  # callables that spin_once calls, one each time
        self.node: Any = None

    def modules(self) -> dict[str, dict[str, Any]]:
        return {
            "rclpy": {"init": self.init},
            "rclpy.context": {"Context": lambda: SimpleNamespace(try_shutdown=self.shut_down)},
            "rclpy.duration": {"Duration": lambda seconds: seconds},
            "rclpy.executors": {"SingleThreadedExecutor": lambda context: Executor(self)},
            "rclpy.node": {"Node": lambda name, context: Node(self, name)},
            "rclpy.qos": {
                "QoSProfile": lambda **policies: policies,
                **{f"{x}Policy": SimpleNamespace(**POLICIES) for x in POLICY_KINDS},
            },
            "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO="no")},
            "rcl_interfaces": {},
            "rcl_interfaces.msg": {"ParameterDescriptor": Descriptor},
            "std_srvs": {},
            "std_srvs.srv": {"Trigger": "Trigger"},
            "geometry_msgs": {},
            "geometry_msgs.msg": {"Twist": Twist, "TwistStamped": TwistStamped},
        }

    def init(self, *, args: list[str], context: Any, signal_handler_options: str) -> None:
        assert args is sys.argv  # parameters, remappings
        assert signal_handler_options == "no"
        self.calls.append("init")

    def shut_down(self) -> None:
        self.calls.append("context.try_shutdown")


POLICY_KINDS = ("History", "Reliability", "Durability")
POLICIES = {"KEEP_LAST": "keep last", "RELIABLE": "reliable", "VOLATILE": "volatile"}
QOS = {"history": "keep last", "reliability": "reliable", "durability": "volatile"}


class Descriptor:
    def __init__(self, *, description: str, read_only: bool, dynamic_typing: bool) -> None:
        assert description
        self.read_only, self.dynamic_typing = read_only, dynamic_typing


class Twist:
    def __init__(self, speed: float = 0.0) -> None:
        self.speed = speed


class TwistStamped(Twist):
    def __init__(self, speed: float = 0.0) -> None:
        super().__init__(speed)
        self.header = SimpleNamespace(stamp=None)


class Node:
    def __init__(self, ros: Ros, name: str) -> None:
        self.ros, self.name, ros.node = ros, name, self
        self.values: dict[str, Any] = {}
        self.services: dict[str, Any] = {}
        self.subscribed: dict[str, Any] = {}

    def declare_parameter(self, name: str, value: Any, descriptor: Descriptor) -> None:
        assert type(value) in (bool, int, float, str)
        assert descriptor.read_only
        assert descriptor.dynamic_typing
        self.values[name] = self.ros.overrides.get(name, value)

    def get_parameter(self, name: str) -> Any:
        return SimpleNamespace(value=self.values[name])

    def get_fully_qualified_name(self) -> str:
        return f"/{self.name}"

    def create_service(self, kind: str, name: str, callback: Any) -> None:
        self.services[name] = callback

    def create_publisher(self, kind: type, topic: str, qos: dict[str, Any]) -> Any:
        assert topic == "cmd_vel"
        assert qos == {**QOS, "depth": 10}  # TurtleBot3's
        return SimpleNamespace(publish=self.ros.published.append, wait_for_all_acked=unable)

    def create_subscription(self, kind: type, topic: str, callback: Any, qos: Any) -> None:
        self.subscribed[topic] = (kind, callback)

    def resolve_topic_name(self, topic: str) -> str:
        return f"/{topic}"

    def get_subscriptions_info_by_topic(self, topic: str) -> list[Any]:
        assert topic == "/cmd_vel"
        return [SimpleNamespace(topic_type=kind) for kind in self.ros.listeners]

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.ros.calls.append)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: "now"))

    def destroy_node(self) -> None:
        self.ros.calls.append("destroy_node")


def unable(timeout: float) -> bool:
    raise NotImplementedError("this middleware cannot")


class Executor:
    def __init__(self, ros: Ros) -> None:
        self.ros, self.is_shutdown = ros, False

    def add_node(self, node: Node) -> bool:
        return True

    def spin_once(self, *, timeout_sec: float) -> None:
        assert not self.is_shutdown  # else guard conditions may be gone under it
        if self.ros.now:
            self.ros.now.pop(0)()
        time.sleep(1e-3)

    def shutdown(self) -> bool:
        self.ros.calls.append("executor.shutdown")
        self.is_shutdown = True
        return True


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Iterator[Ros]:
    made = Ros()
    for name, members in made.modules().items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    yield made
    for name in ("run", "deadman"):
        sys.modules.pop(f"{MODULES}.{name}", None)


def test_the_node_runs_bridges_run(ros: Ros, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module(f"{MODULES}.run")
    ros.overrides = {"bundle": "p.safetensors", "episodes": 3, "link.namespace": "lab"}
    driven: list[Any] = []

    def run(config: RunConfig, ask: Any) -> int:
        driven.append((config, ask))
        return 3

    monkeypatch.setattr(module, "run", run)
    with pytest.raises(SystemExit) as exit_:
        module.main()

    assert exit_.value.code == 3
    ((config, ask),) = driven
    assert (config.robot, config.bundle, config.episodes) == ("rclpy", "p.safetensors", 3)
    assert config.link.namespace == "lab"
    assert ask.__name__ == "ask"  # there is no terminal here: the service
    assert ros.calls == ["init", "executor.shutdown", "destroy_node", "context.try_shutdown"]


def test_a_wrong_parameter_is_told(ros: Ros, capsys: pytest.CaptureFixture[str]) -> None:
    module = importlib.import_module(f"{MODULES}.run")
    ros.overrides = {"mode": "explore"}
    with pytest.raises(SystemExit) as exit_:
        module.main()

    assert exit_.value.code == 2
    assert "mode=explore is not allowed" in capsys.readouterr().err


def test_the_service_answers_questions_and_nothing_else(
    ros: Ros, capsys: pytest.CaptureFixture[str]
) -> None:
    module = importlib.import_module(f"{MODULES}.run")
    with module.RunNode() as node:
        (answer,) = ros.node.services.values()
        assert list(ros.node.services) == ["~/go_on"]
        assert not answer("request", SimpleNamespace()).success  # too early: nothing was asked
        asker = threading.Thread(target=node.ask, args=("Is the floor free?",), daemon=True)
        asker.start()
        asker.join(0.2)
        assert asker.is_alive()
        assert answer("request", SimpleNamespace()).success
        asker.join(10)
        assert not asker.is_alive()
        assert not answer("request", SimpleNamespace()).success  # once

    told = capsys.readouterr().out
    assert "Is the floor free?" in told
    assert "ros2 service call /emrld_run/go_on std_srvs/srv/Trigger" in told


def test_silence_is_broken_several_times_and_then_kept(ros: Ros) -> None:
    deadman = importlib.import_module(f"{MODULES}.deadman")
    silence = deadman.Silence(timeout=0.5)

    assert not silence.due(100.0)  # nobody has ever driven
    silence.command(100.0)
    assert [silence.due(100.0 + t) for t in (0.1, 0.5)] == [False, False]
    assert [silence.due(100.51 + 0.05 * i) for i in range(7)] == [True] * 5 + [False] * 2
    silence.command(102.0)
    assert [silence.due(t) for t in (102.4, 102.6)] == [False, True]


@pytest.mark.parametrize("kind", [Twist, TwistStamped])
def test_commands_go_through_and_silence_stops_the_robot(ros: Ros, kind: Any) -> None:
    deadman = importlib.import_module(f"{MODULES}.deadman")
    ros.listeners = ["std_msgs/msg/Other", f"geometry_msgs/msg/{kind.__name__}"]
    ros.overrides = {"timeout": 0.1}
    end = time.monotonic() + 20

    def stopped() -> bool:
        return len(ros.published) >= 4 or time.monotonic() > end

    ros.now = [lambda: take(ros, kind(0.2)), lambda: take(ros, kind(0.1))]
    deadman.relay(Node(ros, "n"), Executor(ros), stopped)

    # what came, zero twice by the silence, and zero again at the end
    assert [message.speed for message in ros.published] == [0.2, 0.1, *[0.0] * 7]
    assert all(type(message) is kind for message in ros.published)
    if kind is TwistStamped:
        assert ros.published[-1].header.stamp == "now"


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP"])
def test_whatever_ends_the_deadman_stops_the_robot(ros: Ros, name: str) -> None:
    deadman = importlib.import_module(f"{MODULES}.deadman")
    ros.overrides = {"command_type": "twist", "timeout": 60.0}
    number = signal.Signals[name]
    ros.now = [lambda: take(ros, Twist(0.2)), lambda: os.kill(os.getpid(), number)]
    before = {each: signal.getsignal(each) for each in deadman.SIGNALS}
    try:
        deadman.main()
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)

    assert [message.speed for message in ros.published] == [0.2, *[0.0] * 5]
    assert ros.calls[-3:] == ["executor.shutdown", "destroy_node", "context.try_shutdown"]


def take(ros: Ros, message: Any) -> None:
    kind, callback = ros.node.subscribed["cmd_vel_in"]
    assert type(message) is kind
    callback(message)


def test_nothing_is_sent_before_anybody_drives(ros: Ros) -> None:
    deadman = importlib.import_module(f"{MODULES}.deadman")
    ros.overrides = {"command_type": "twist", "timeout": 0.001}
    looks = iter([False] * 20)

    deadman.relay(Node(ros, "n"), Executor(ros), lambda: next(looks, True))

    assert ros.published == []


def test_two_types_of_commands_are_refused(ros: Ros) -> None:
    deadman = importlib.import_module(f"{MODULES}.deadman")
    ros.listeners = ["geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"]
    with pytest.raises(SystemExit, match="say by command_type"):
        deadman.relay(Node(ros, "n"), Executor(ros), lambda: False)
    ros.overrides = {"timeout": 0.0}
    with pytest.raises(SystemExit, match="timeout=0 is not allowed"):
        deadman.relay(Node(ros, "n"), Executor(ros), lambda: False)


# Python of Humble

LOADED = f"""
import sys
import bridges.run, bridges.sim_turtlebot, bridges.import_bag, bridges.transports.memory
import {MODULES}.parameters
ours = [m.__file__ for m in sys.modules.values() if (m.__name__ + ".").startswith(OURS)]
print(*filter(None, ours), "jax" in sys.modules)
""".replace("OURS", "('bridges.', 'emrld_jax.')")
NEWER = {  # than Python 3.10
    *("Self", "LiteralString", "Never", "Required", "NotRequired", "Unpack", "TypeVarTuple"),
    *("assert_never", "assert_type", "reveal_type", "UTC", "StrEnum", "ReprEnum", "verify"),
    *("tomllib", "ExceptionGroup", "BaseExceptionGroup", "TaskGroup", "Runner", "batched"),
}


def test_the_robots_part_needs_no_newer_python_than_humbles() -> None:
    """Found by reading it: Python 3.10 is not there wherever tests run."""
    done = subprocess.run(
        [sys.executable, "-c", LOADED],
        check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    *files, jax = done.stdout.split()
    trees = {
        file: ast.parse(source, feature_version=(3, 10))
        for file, source in ((file, Path(file).read_text()) for file in files)
    }
    used = {
        f"{file}:{node.lineno}"
        for file, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Name | ast.Attribute | ast.ImportFrom | ast.Import)
        and names_of(node) & NEWER
    }

    assert jax == "False"
    assert {"robot.py", "modes.py", "parameters.py"} <= {Path(file).name for file in files}
    assert used == set()


def names_of(node: Any) -> set[str]:
    """Names that a node of source uses or brings in."""
    if isinstance(node, ast.Import | ast.ImportFrom):
        return {alias.name for alias in node.names}
    return {node.id if isinstance(node, ast.Name) else node.attr}


def text(root: ElementTree.Element, path: str) -> str:
    found = root.find(path)
    assert found is not None
    return str(found.text)


def set_up() -> dict[str, Any]:
    """What setup.py tells setuptools."""
    told: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        setuptools = ModuleType("setuptools")
        vars(setuptools)["setup"] = lambda **values: told.update(values)
        patch.setitem(sys.modules, "setuptools", setuptools)
        runpy.run_path(str(PACKAGE / "setup.py"))
    return told
