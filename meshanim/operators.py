"""C++ kernels as torch operators, which autograd, autocast and torch.compile understand."""

from collections.abc import Callable

import torch
from torch._ops import OpOverload

__all__ = ["cpu_operator", "once_differentiable"]


def cpu_operator(name: str) -> Callable[[Callable], OpOverload]:
    """Make `meshanim::name` an operator, whose kernel on the CPU is the decorated function.

    Its outputs must not share memory with its inputs, as `torch.library.opcheck` checks in the tests;
    `torch.library.custom_op` checks at every call, and at the first loads torch.compile, which takes longer
    than to animate a sentence.
    """

    def register(function: Callable) -> OpOverload:
        qualified = f"meshanim::{name}"
        schema = torch.library.infer_schema(function, mutates_args=())
        torch.library.define(qualified, schema, tags=(torch.Tag.pt2_compliant_tag,))
        torch.library.impl(qualified, "cpu", function)
        return getattr(torch.ops.meshanim, name).default

    return register


def once_differentiable(operator: OpOverload) -> None:
    """Refuse to differentiate an operator, which is a derivative itself."""

    def refuse(ctx, *grads):
        raise RuntimeError(f"{operator.name()} has no derivative: this can be differentiated once")

    torch.library.register_autograd(operator, refuse)
