"""A policy as an ONNX graph, for whatever runs those: a robot, a browser, another language.

The networks act on anything that follows the array API, so the graph is what they do to an array that only writes down
what is done to it. A network or non-linearity that is added later exports by itself, if the operations here do for it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from saclab.errors import UserError
from saclab.extras import required
from saclab.files import absolute, replace_file
from saclab.records import PolicyDescription
from saclab.trained_policy import TrainedPolicy, load_policy, on_disk, read_description

OPERATIONS = {
    "add": "Add", "divide": "Div", "exp": "Exp", "greater": "Greater", "matmul": "MatMul", "maximum": "Max",
    "minimum": "Min", "multiply": "Mul", "negative": "Neg", "rint": "Round", "sqrt": "Sqrt", "subtract": "Sub",
    "tanh": "Tanh",
}  # fmt: skip
"""NumPy's name -> ONNX's, of operations number by number and of the product of matrices."""
OPERATOR_SET = 17
ROWS = -1
"""Stands for the number of rows, which is known when the graph runs."""


class Graph:
    """The nodes so far; every value is [rows, width]."""

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def input(self, name: str, width: int) -> Traced:
        return Traced(self, name, width, np.dtype(np.float32))

    def constant(self, value: Any, kind: Any) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.array(value, kind), name))
        return name

    def add(self, operation: str, inputs: Sequence[str], width: int, kind: Any, **attributes: Any) -> Traced:
        name = f"value_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operation, list(inputs), [name], **attributes))
        return Traced(self, name, width, np.dtype(kind))

    def apply(self, operation: str, operands: Sequence[Any], width: int, result: Any = None) -> Traced:
        """An operation on values and NumPy's arrays and numbers, in the type that NumPy would choose."""
        known = [operand.dtype for operand in operands if isinstance(operand, Traced | np.ndarray | np.generic)]
        kind = np.result_type(*known)
        names = [
            operand.astype(kind).name if isinstance(operand, Traced) else self.constant(operand, kind)
            for operand in operands
        ]
        return self.add(operation, names, width, result or kind)


class Traced(NDArrayOperatorsMixin):
    """A value [rows, width] of the graph."""

    def __init__(self, graph: Graph, name: str, width: int, dtype: np.dtype[Any]) -> None:
        self.graph, self.name, self.dtype = graph, name, dtype
        self.shape = ROWS, width

    def __array_namespace__(self, api_version: str | None = None) -> Namespace:
        return Namespace(self.graph)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *operands: Any, **options: Any) -> Traced:
        if method != "__call__" or options or ufunc.__name__ not in OPERATIONS:
            raise UserError(
                f"this policy cannot be exported: its network calls numpy.{ufunc.__name__}, whose ONNX operation is "
                "not in saclab.onnx_export.OPERATIONS"
            )
        if ufunc is np.matmul:
            width = operands[1].shape[-1]
        else:
            width = max(np.shape(operand)[-1] for operand in operands if np.ndim(operand))
        return self.graph.apply(OPERATIONS[ufunc.__name__], operands, width, bool if ufunc is np.greater else None)

    @property
    def ndim(self) -> int:
        return 2

    def __getitem__(self, key: tuple[Any, slice]) -> Traced:
        """Columns: value[..., first:last]."""
        rows, columns = key
        assert rows is Ellipsis
        assert columns.step is None
        first, last, _ = columns.indices(self.shape[1])
        ends = [self.graph.constant([place], np.int64) for place in (first, last, 1)]
        return self.graph.add("Slice", [self.name, *ends], last - first, self.dtype)

    def astype(self, kind: Any, copy: bool = True) -> Traced:
        if self.dtype == kind:
            return self
        to = self.graph.onnx.helper.np_dtype_to_tensor_dtype(np.dtype(kind))
        return self.graph.add("Cast", [self.name], self.shape[1], kind, to=to)

    def sum(self, axis: int, keepdims: bool) -> Traced:
        assert axis == -1
        return self.graph.add(
            "ReduceSum", [self.name, self.graph.constant([-1], np.int64)], 1, self.dtype, keepdims=int(keepdims)
        )


class Namespace:
    """What the networks call by the array's namespace; of arrays that are known, NumPy's own."""

    tanh, exp, sqrt, maximum, minimum = np.tanh, np.exp, np.sqrt, np.maximum, np.minimum

    def __init__(self, graph: Graph) -> None:
        self.graph = graph

    def expm1(self, value: Traced) -> Traced:
        grown: Traced = np.exp(value) - np.float32(1)
        return grown

    def where(self, condition: Traced, yes: Traced, no: Any) -> Traced:
        other = self.graph.constant(no, yes.dtype) if not isinstance(no, Traced) else no.name
        return self.graph.add("Where", [condition.name, yes.name, other], yes.shape[1], yes.dtype)

    def concat(self, values: Sequence[Traced], axis: int) -> Traced:
        assert axis == -1
        width = sum(value.shape[1] for value in values)
        return self.graph.add("Concat", [value.name for value in values], width, values[0].dtype, axis=-1)

    def full(self, shape: tuple[int, int], value: float, dtype: Any) -> Traced:
        """One number in every row: as many as the observations have."""
        assert shape[0] == ROWS
        of_input = self.graph.add("Shape", ["observation"], 2, np.int64)
        rows = self.graph.add(
            "Slice", [of_input.name, *(self.graph.constant([n], np.int64) for n in (0, 1))], 1, np.int64
        )
        size = self.graph.add("Concat", [rows.name, self.graph.constant([shape[1]], np.int64)], 2, np.int64, axis=0)
        return self.graph.add("Expand", [self.graph.constant([[value]], dtype), size.name], shape[1], dtype)

    def mean(self, value: Traced, axis: int, keepdims: bool) -> Traced:
        assert axis == -1
        return self.graph.add("ReduceMean", [value.name], 1, value.dtype, axes=[-1], keepdims=int(keepdims))


def export_onnx(run: Path | str, path: Path | str) -> None:
    """Write the best policy of a run as an ONNX file.

    Its inputs are `observation` f32[rows, O] and `noise` f32[rows, A], standard normal, 0 if it is not given; its
    outputs `action` [rows, A], of the mean, and `sampled_action` [rows, A], of the mean and the noise. Both lie within
    the environment's bounds and are of its type; normalisation of observations is inside.

    Args:
        run: the run folder, a folder that holds a policy, or hf:user/name.
        path: of the file.

    Raises:
        UserError: if there is no policy, the extra `onnx` is not installed, the network calls what ONNX is not known to
            have, or the file cannot be written.
    """
    required("onnx", "onnx", "export")
    run = on_disk(run)
    policy, description = load_policy(run), read_description(run)
    model, path = onnx_model(policy, description), absolute(Path(path))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, model.SerializeToString())
    except OSError as error:
        raise UserError(f"out = {str(path)!r}: {error.strerror or error}; name another file with --out") from error


def onnx_model(policy: TrainedPolicy, description: PolicyDescription) -> Any:
    """The model as onnx's own object, checked by onnx."""
    import onnx

    spec, helper = policy.spec, onnx.helper
    graph = Graph(onnx)
    observation, noise = graph.input("observation", spec.observation_size), graph.input("noise", spec.action_size)
    mean, log_std = policy.policy.distribution(policy.parameters, observation)
    actions = {"action": np.tanh(mean), "sampled_action": np.tanh(mean + np.exp(log_std) * noise)}
    outputs = []
    for name, action in actions.items():
        scaled: Any = spec.scale_action(action)
        graph.nodes.append(helper.make_node("Identity", [scaled.name], [name]))
        kind = helper.np_dtype_to_tensor_dtype(scaled.dtype)
        outputs.append(helper.make_tensor_value_info(name, kind, ["rows", spec.action_size]))
    inputs = [
        helper.make_tensor_value_info("observation", onnx.TensorProto.FLOAT, ["rows", spec.observation_size]),
        helper.make_tensor_value_info("noise", onnx.TensorProto.FLOAT, ["noise_rows", spec.action_size]),
    ]
    without_noise = onnx.numpy_helper.from_array(np.zeros((1, spec.action_size), np.float32), "noise")
    body = helper.make_graph(graph.nodes, "policy", inputs, outputs, [without_noise, *graph.constants])
    sets = [helper.make_opsetid("", OPERATOR_SET)]
    model = helper.make_model(body, opset_imports=sets, ir_version=8, producer_name="saclab")
    helper.set_model_props(model, {"policy": json.dumps(msgspec.to_builtins(description))})
    onnx.checker.check_model(model, full_check=True)
    return model
