"""A traced function as an ONNX graph: a node or two for each primitive that the tick of an agent uses.

The package jax2onnx would do the same, but its 0.17 cannot be installed beside this one: it needs orbax-checkpoint
before 0.11.37, checkpoints here need 0.12.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import onnx
from jax.extend.core import Literal
from jax.interpreters.partial_eval import dce_jaxpr
from onnx import helper, numpy_helper

OPSET, IR = 18, 8  # of 2022: any runtime since reads them
# A primitive: its operator, the parameters that are further inputs, and those that are attributes.
OPERATORS: dict[str, tuple[str, tuple[str, ...], dict[str, str]]] = {
    **{name: (name.title(), (), {}) for name in ("add", "sub", "mul", "div", "max", "min", "exp", "tanh", "or", "and",
                                                  "abs", "neg", "sqrt")},
    "logistic": ("Sigmoid", (), {}), "eq": ("Equal", (), {}), "ge": ("GreaterOrEqual", (), {}),
    "gt": ("Greater", (), {}), "lt": ("Less", (), {}), "squeeze": ("Squeeze", ("dimensions",), {}),
    "reshape": ("Reshape", ("new_sizes",), {}), "slice": ("Slice", ("start_indices", "limit_indices"), {}),
    "split": ("Split", ("sizes",), {"axis": "axis"}), "concatenate": ("Concat", (), {"axis": "dimension"}),
    "transpose": ("Transpose", (), {"perm": "permutation"}),
}  # fmt: skip


def to_onnx(function: Callable, inputs: dict[str, Any], outputs: Sequence[str]) -> bytes:
    """Return the ONNX file of a function of named arrays with a flat sequence of results, or NotImplementedError."""
    traced, graph = jax.make_jaxpr(function)(*inputs.values()), _Graph()
    for name, result in zip(outputs, graph.inline(traced, list(inputs)), strict=True):
        graph.nodes.append(helper.make_node("Identity", [result], [name]))  # a result may be an input as it is
    arguments, results = map(_info, inputs, traced.in_avals), map(_info, outputs, traced.out_avals)
    model = helper.make_graph(graph.nodes, "tick", [*arguments], [*results], graph.constants)
    return helper.make_model(model, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR).SerializeToString()


def _info(name: str, x: Any) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(x.dtype), x.shape)


class _Graph:
    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, value: Any, dtype: Any = np.int64) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), f"constant{len(self.constants)}"))
        return self.constants[-1].name

    def add(self, operator: str, inputs: Sequence[str], count: int = 1, **attributes: Any) -> list[str]:
        results = [f"result{len(self.nodes)}.{i}" for i in range(count)]
        self.nodes.append(helper.make_node(operator, inputs, results, **attributes))
        return results

    def inline(self, traced: Any, inputs: Sequence[str]) -> list[str]:
        """Add the equations of a closed jaxpr that its results depend on, and return the names of the results."""
        jaxpr: Any = dce_jaxpr(traced.jaxpr, [True] * len(traced.jaxpr.outvars), instantiate=True)[0]
        constants = dict(zip(jaxpr.constvars, traced.consts, strict=True))
        names = dict(zip(jaxpr.invars, inputs, strict=True))

        def name(x: Any) -> str:
            aval: Any = x.aval
            if isinstance(x, Literal):
                return self.constant(x.val, aval.dtype)
            return names[x] if x in names else names.setdefault(x, self.constant(constants[x], aval.dtype))

        for equation in jaxpr.eqns:
            names |= zip(equation.outvars, self.node(equation, [*map(name, equation.invars)]), strict=True)
        return [*map(name, jaxpr.outvars)]

    def node(self, equation: Any, inputs: list[str]) -> list[str]:
        params, kind = equation.params, equation.primitive.name
        if kind in OPERATORS:
            operator, further, attributes = OPERATORS[kind]
            inputs = [*inputs, *(self.constant(params[x]) for x in further)]
            attributes = {x: params[y] for x, y in attributes.items()}
            return self.add(operator, inputs, len(equation.outvars), **attributes)
        match kind:
            case "jit" | "pjit":
                return self.inline(params["jaxpr"], inputs)
            case "custom_jvp_call":
                return self.inline(params["call_jaxpr"], inputs)
            case "square":
                return self.add("Mul", inputs * 2)
            case "rsqrt":
                return self.add("Reciprocal", self.add("Sqrt", inputs))
            case "select_n":
                return self.add("Where", [inputs[0], inputs[2], inputs[1]])
            case "convert_element_type":
                return self.add("Cast", inputs, to=helper.np_dtype_to_tensor_dtype(params["new_dtype"]))
            case "dot_general" if params["dimension_numbers"][0] == ((equation.invars[0].aval.ndim - 1,), (0,)):
                return self.add("MatMul", inputs)
        return self.along_axes(equation, inputs)

    def along_axes(self, equation: Any, inputs: list[str]) -> list[str]:
        """Add an equation whose parameters are axes and shapes."""
        params = equation.params
        match equation.primitive.name:
            case "reduce_sum" | "reduce_max" as kind:
                operator = {"reduce_sum": "ReduceSum", "reduce_max": "ReduceMax"}[kind]
                return self.add(operator, [*inputs, self.constant(params["axes"])], keepdims=0)
            case "argmax":
                place = self.add("ArgMax", inputs, axis=params["axes"][0], keepdims=0)
                return self.add("Cast", place, to=helper.np_dtype_to_tensor_dtype(params["index_dtype"]))
            case "iota" if len(params["shape"]) == 1:
                return [self.constant(np.arange(*params["shape"]), params["dtype"])]
            case "dynamic_slice":
                sizes, axis = params["slice_sizes"], self.constant([0])
                begin = self.add("Concat", [self.add("Unsqueeze", [x, axis])[0] for x in inputs[1:]], axis=0)
                begin = self.add("Cast", begin, to=onnx.TensorProto.INT64)
                return self.add("Slice", [inputs[0], *begin, *self.add("Add", [*begin, self.constant(sizes)])])
            case "gather" if params["slice_sizes"] == (1,):  # of a vector, by indices [..., 1]
                return self.add("Gather", [inputs[0], *self.add("Squeeze", [inputs[1], self.constant([-1])])])
            case "stack":
                rows = [self.add("Unsqueeze", [x, self.constant([params["axis"]])])[0] for x in inputs]
                return self.add("Concat", rows, axis=params["axis"])
            case "broadcast_in_dim":
                new = [i for i in range(len(params["shape"])) if i not in params["broadcast_dimensions"]]
                rows = self.add("Unsqueeze", [*inputs, self.constant(new)])
                return self.add("Expand", [*rows, self.constant(params["shape"])])
        raise NotImplementedError(f"expected a primitive with a node in {__name__}, got {equation}")
