"""Numba functions that exist only inside the kernels that call them.

`numba.njit(forceinline=True)` gives each such function its own optimisation, machine code and
Python wrapper, although the kernels around it use nothing but its LLVM code. Leaving that out
halves the time of compilation; the kernels keep their bits. Python's first call of such a function
compiles it as a kernel.
"""

from typing import Any, Literal

from llvmlite import binding as llvm
from numba.core import codegen, compiler, typed_passes
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typing.templates import Signature


class InlinedDispatcher(CPUDispatcher):
    """Function that is compiled into the kernels that call it."""

    for_python: Any
    """The same function as a kernel, which Python's calls run."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Run the function as a kernel of its own."""
        return self.for_python(*args, **kwargs)

    def add_overload(self, cres: Any) -> None:
        """Register a compiled signature for kernels alone."""
        self.overloads[tuple(cres.signature.args)] = cres


class _Library(codegen.JITCodeLibrary):
    """LLVM code without optimisation and machine code."""

    def finalize(self) -> None:
        """Link the functions that this one calls."""
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(typed_passes.NativeLowering):
    """Last pass: LLVM code, instead of machine code."""

    _name = "inlined_lowering"

    def run_pass(self, state: Any) -> Literal[True]:
        context = state.targetctx
        state.library = _Library(context.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        state.library.finalize()
        signature = Signature(state.return_type, state.args, recvr=None)
        state.cr = _result(context, state.library, state.cr.fndesc, state.cr.env, signature)
        context.insert_user_function(state.cr.entry_point, state.cr.fndesc, [state.library])
        return True


class InlinedCompiler(compiler.CompilerBase):
    """Numba's compiler up to the code that other functions take in."""

    def define_pipelines(self) -> list[Any]:
        """Return the passes of Numba's compiler, the last one replaced."""
        passes = compiler.DefaultPassBuilder.define_nopython_pipeline(self.state).passes
        pipeline = PassManager("inlined")
        for one, name in passes:
            if one is typed_passes.NativeLowering:
                pipeline.add_pass(_Lowering, name)
            elif one is not typed_passes.NoPythonBackend:
                pipeline.add_pass(one, name)
        pipeline.finalize()
        return [pipeline]


def _result(context: Any, library: Any, fndesc: Any, environment: Any, signature: Any) -> Any:
    # Kernels find the function by its entry point, which only has to be unique.
    return compiler.compile_result(
        typing_context=context.typing_context,
        target_context=context,
        entry_point=object(),
        library=library,
        fndesc=fndesc,
        environment=environment,
        signature=signature,
        type_annotation="",
        objectmode=False,
        lifted=(),
        reload_init=(),
    )


def reduce(result: Any) -> tuple[Any, ...]:
    """Return a compiled function as values that can be pickled, its code as bitcode."""
    result.fndesc.typemap = result.fndesc.calltypes = None
    code = result.library._get_module_for_linking().as_bitcode()
    return result.library.name, code, result.fndesc, result.environment, result.signature


def rebuild(context: Any, payload: tuple[Any, ...]) -> Any:
    """Return a compiled function from what `reduce` returned."""
    name, code, *rest = payload
    library = _Library(context.codegen(), name)
    library._final_module = library._shared_module = llvm.parse_bitcode(code)
    library._finalized = True
    return _result(context, library, *rest)
