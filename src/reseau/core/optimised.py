"""Machine code of a loop from one optimisation of it and of all that it calls.

Numba makes a library of each function: it is optimised, linked into those of the functions that call it, and
optimised there again, and machine code is made of every one. Here what a loop calls is only linked, and
optimised once, with the loop, of which alone there is machine code.

These are parts of Numba that are not documented for others; therefore the package depends on the versions of
Numba with which it is tested.
"""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler

_FIRST, _THEN = {"opt": 1, "loop_vectorize": False}, {"opt": 2}
"""Levels of LLVM's optimisation: loops become vector instructions after what they call is in them and simple.
The third level takes longer, and loops are not faster."""


class _Nowhere:
    """The place of machine code that is not made."""

    @staticmethod
    def set_env(name: str, environment: Any) -> None:
        """Do nothing: the environment of a function is that of the loop."""


class _Part(JITCodeLibrary):
    """What a loop calls, with all that it calls itself: to be linked, not to be run."""

    codegen = _Nowhere

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def finalize(self) -> None:
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        return 0


class _Whole(JITCodeLibrary):
    """A loop with all that it calls."""

    _optimize_functions = _Part._optimize_functions

    def _optimize_final_module(self) -> None:
        for level in _FIRST, _THEN:
            passes, builder = self._codegen._module_pass_manager(**level)
            passes.run(self._final_module, builder)


class Optimised(Compiler):
    """Compiler of a loop."""

    def compile_extra(self, func: Any) -> Any:
        """Compile it into a library of its own, and what it calls into parts."""
        codegen = self.state.targetctx.codegen()
        self.state.library = _Whole(codegen, func.__qualname__)
        self.state.library.enable_object_caching()
        usual, codegen._library_class = codegen._library_class, _Part
        try:
            return super().compile_extra(func)
        finally:
            codegen._library_class = usual
