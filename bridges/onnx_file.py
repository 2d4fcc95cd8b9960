"""A bundle's network as an ONNX model, for runtimes that are not Python's (extra `onnx`).

Input `observation` [N, O]; outputs `mean_action` [N, A] in policy units, `physical_action` [N, A],
which is what the environment executes of it, and `standard_deviation` [A]; all float32. The
metadata's `emrld` is the bundle's JSON.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np

from bridges.activations import GELU_CUBIC, SQRT_2_OVER_PI
from bridges.bundle import KEY, Bundle, about_text
from bridges.messages import BridgeError
from bridges.policy import LEAST_SQUARE

OPSET, IR_VERSION = 17, 8  # of 2022: old runtimes read them, and they have all that is needed
PRODUCER = "emrld-jax"
INPUT, OUTPUTS = "observation", ("mean_action", "physical_action", "standard_deviation")


def check_installed() -> None:
    """Looks for what this module needs.

    Raises:
        BridgeError: it is not there; names the extra that brings it.
    """
    for package in ("onnx", "onnxruntime"):
        if find_spec(package) is None:
            raise BridgeError(f"{package} is not installed: pip install -e '.[onnx]'")


def model(bundle: Bundle) -> bytes:
    """The model's file."""
    import onnx  # noqa: PLC0415
    from onnx import helper  # noqa: PLC0415

    graph = _Graph()
    mean = _network(graph, bundle)
    physical = _bounded(graph, bundle, mean)
    std = graph.constant("std", np.exp(bundle.tensors["policy/log_std"].astype(np.float64)))
    for source, name in zip((mean, physical, std), OUTPUTS, strict=True):
        graph.add("Identity", source, name=name)
    seen, done = bundle.observation, bundle.action
    policy_units = ["policy units"] * len(done.names)
    inputs = [_value(INPUT, True, seen.names, seen.units)]
    outputs = [
        _value(OUTPUTS[0], True, done.names, policy_units),
        _value(OUTPUTS[1], True, done.names, done.units),
        _value(OUTPUTS[2], False, done.names, policy_units),
    ]
    made = helper.make_model(
        helper.make_graph(graph.nodes, "policy", inputs, outputs, graph.constants),
        producer_name=PRODUCER,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    helper.set_model_props(made, {KEY: about_text(bundle)})
    onnx.checker.check_model(made, full_check=True)
    return bytes(made.SerializeToString())


def runner(model: bytes) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """The model in onnxruntime: observations [N, O] -> mean and physical actions, [N, A] each."""
    import onnxruntime  # noqa: PLC0415

    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])

    def act(obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean, physical = session.run(list(OUTPUTS[:2]), {INPUT: np.asarray(obs, np.float32)})
        return mean, physical

    return act


class _Graph:
    """Nodes and constants, each with a name of its own."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, name: str, value: Any) -> str:
        from onnx import numpy_helper  # noqa: PLC0415

        array = np.asarray(value, np.float32)
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def add(self, operator: str, *inputs: str, name: str = "", **attributes: Any) -> str:
        from onnx import helper  # noqa: PLC0415

        name = name or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [name], name=name, **attributes))
        return name


def _network(graph: _Graph, bundle: Bundle) -> str:
    """The mean action of the input."""
    x = graph.add("Asinh", INPUT) if bundle.policy.squash else INPUT
    last = len(bundle.policy.hidden_sizes)
    for i in range(last + 1):
        weights = [
            graph.constant(place, bundle.tensors[place])
            for place in (f"policy/layer_{i}/kernel", f"policy/layer_{i}/bias")
        ]
        x = graph.add("Gemm", x, *weights)
        if i < last:
            x = _ACTIVATIONS[bundle.policy.activation](graph, x)
    return x


def _silu(graph: _Graph, x: str) -> str:
    return graph.add("Mul", x, graph.add("Sigmoid", x))


def _gelu(graph: _Graph, x: str) -> str:
    """As `bridges.activations` has it."""
    at = len(graph.nodes)
    cubic, factor, half, one = (
        graph.constant(f"gelu_{at}_{k}", value)
        for k, value in enumerate((GELU_CUBIC, SQRT_2_OVER_PI, 0.5, 1.0))
    )
    cube = graph.add("Mul", graph.add("Mul", graph.add("Mul", x, x), x), cubic)
    inner = graph.add("Mul", graph.add("Add", x, cube), factor)
    gate = graph.add("Add", graph.add("Tanh", inner), one)
    return graph.add("Mul", graph.add("Mul", x, gate), half)


_ACTIVATIONS: dict[str, Callable[[_Graph, str], str]] = {
    "tanh": lambda graph, x: graph.add("Tanh", x),
    "relu": lambda graph, x: graph.add("Relu", x),
    "silu": _silu,
    "elu": lambda graph, x: graph.add("Elu", x, alpha=1.0),
    "gelu": _gelu,
}


def _bounded(graph: _Graph, bundle: Bundle, mean: str) -> str:
    """As `bridges.policy.bounded` has it."""
    low, high = (np.array(bounds) for bounds in (bundle.action.low, bundle.action.high))
    half, middle = graph.constant("half", 0.5 * (high - low)), 0.5 * (high + low)
    physical = graph.add("Add", graph.add("Mul", mean, half), graph.constant("middle", middle))
    if bundle.action.bounding == "box":
        least, most = graph.constant("low", low), graph.constant("high", high)
        return graph.add("Min", graph.add("Max", physical, least), most)
    length = graph.add("ReduceL2", physical, axes=[1], keepdims=1)
    safe = graph.add("Max", length, graph.constant("least", np.sqrt(LEAST_SQUARE)))
    share = graph.add("Div", graph.constant("bound", high[0]), safe)
    return graph.add("Mul", physical, graph.add("Min", share, graph.constant("one", 1.0)))


def _value(name: str, many: bool, names: list[str], units: list[str]) -> Any:
    """An input or output, [N, ..] or [..], with the names and units of its numbers."""
    from onnx import TensorProto, helper  # noqa: PLC0415

    shape: list[Any] = ["N", len(names)] if many else [len(names)]
    words = ", ".join(f"{n} ({unit})" for n, unit in zip(names, units, strict=True))
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape, doc_string=words)
