"""Calls the law kernels of mechanisms from compiled code, by the address of their machine code.

Every kernel of a mechanism has one of two signatures (`bayeskin.finite_element.kernels`). One compiled driver
therefore calls the kernels of any set of mechanisms, whose addresses are among its arguments. No set needs
its own compilation.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any

from numba import types
from numba.extending import intrinsic

from bayeskin.finite_element.kernels import LINEARISE, RESPOND


def address(kernel: Any) -> int:
    """Returns the address of the machine code of a law kernel, or 0 for None."""
    if kernel is None:
        return 0
    (compilation,) = kernel.overloads.values()
    return int(compilation.library.get_pointer_to_function(compilation.fndesc.llvm_func_name))


def _call(context, builder, signature, args):
    """Calls the function at the address args[0] with the remaining args, in numba's calling convention."""
    arguments = signature.args[1:]
    pointer = context.call_conv.get_function_type(types.none, arguments).as_pointer()
    function = builder.inttoptr(args[0], pointer)
    context.call_conv.call_function(builder, function, types.none, arguments, args[1:])
    return context.get_dummy_value()


@intrinsic
def call_respond(typing, at, time_s, elapsed_s, par, data, f, p, g, before, after, stress, content, flux):
    """Calls the respond kernel at the address `at`."""
    return types.void(types.int64, *RESPOND.args), _call


@intrinsic
def call_linearise(typing, at, time_s, elapsed_s, par, data, f, p, g, before, sf, sp, cf, cp, ff, fg):
    """Calls the linearise kernel at the address `at`."""
    return types.void(types.int64, *LINEARISE.args), _call
