"""How the parts of compiled loops are compiled, and who hears of it when that takes time.

A loop that Python calls is compiled by `numba.njit` and kept on disk. What only such loops call
needs neither: the caller's machine code holds it. The compiler would nevertheless optimise every
part and make machine code of it, and once more in each function between it and the loop. A part is
therefore only translated here, to be linked into its callers, and what is linked together is
optimised once, with the loop.

Only modules of loops import this one: the compiler takes as long to import as all else.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from numba import _dynfunc
from numba.core import event
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering
from numba.extending import register_jitable

from tofclip.compile_observers import observers

F = TypeVar("F", bound=Callable[..., Any])

NO_ADDRESS = 0  # of machine code that is never made


class _PartLibrary(JITCodeLibrary):  # type: ignore[misc]
    """A part's code with that of its own parts, to be linked: not optimised, without machine code."""

    def add_llvm_module(self, ll_module: Any) -> None:
        self._optimize_functions(ll_module)  # callers then have less to look through
        self._final_module.link_in(ll_module)

    def finalize(self) -> None:
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _PartLowering(NativeLowering):  # type: ignore[misc]
    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        library = _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library, state.flags.no_compile = library, True
        super().run_pass(state)
        lowered = state["cr"]
        library.finalize()
        # callers find a part's code by the function that it would be for Python
        name = lowered.fndesc.qualname
        found_by = _dynfunc.make_function(
            lowered.fndesc.lookup_module(), name, name, NO_ADDRESS, lowered.env, (library,)
        )
        state.targetctx.insert_user_function(found_by, lowered.fndesc, [library])
        state["cr"] = lowered._replace(cfunc=found_by)
        return True


class _PartCompiler(Compiler):  # type: ignore[misc]
    def define_pipelines(self) -> list[Any]:
        pipelines: list[Any] = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes = [
                (_PartLowering if step is NativeLowering else step, why)
                for step, why in pipeline.passes
            ]
        return pipelines


compile_as_part: Callable[..., Callable[[F], F]] = partial(
    register_jitable,
    error_model="numpy",
    no_cpython_wrapper=True,
    no_cfunc_wrapper=True,
    pipeline_class=_PartCompiler,
)
"""Make the decorator of functions that compiled loops call, with options of `numba.njit` such as
``fastmath``. Called from Python they run as they are written.
"""


class _CompileListener(event.Listener):  # type: ignore[misc]
    def on_start(self, event: Any) -> None:
        for report in tuple(observers):
            report(event.data["dispatcher"].py_func.__name__)

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _CompileListener())
