"""How kernels take in the functions that they call.

Numba links the code of every called function into its caller and optimises it again there; each
function also gets a Python wrapper. That is most of the time of a compilation. Here a function that
a kernel calls is one of two kinds, neither with a wrapper:

- *inlined*: its LLVM code becomes part of the caller; it has no machine code of its own.
- *called*: it is compiled once, and its callers find it by its name.

Python's first call of such a function compiles it as a kernel. The file of a kernel in the cache
holds the machine code of the functions that it calls.
"""

from typing import Any, ClassVar, Literal

from llvmlite import binding as llvm
from numba.core import codegen, compiler, typed_passes
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.registry import CPUDispatcher
from numba.core.typing.templates import Signature


class LinkedDispatcher(CPUDispatcher):
    """Function of other kernels."""

    for_python: Any
    """The same function as a kernel, which Python's calls run."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Run the function as a kernel of its own."""
        return self.for_python(*args, **kwargs)

    def add_overload(self, cres: Any) -> None:
        """Register a compiled signature for kernels alone."""
        self.overloads[tuple(cres.signature.args)] = cres


class _Library(codegen.JITCodeLibrary):
    symbol: str
    """Name of the function in LLVM code."""


class _Inlined(_Library):
    """LLVM code without optimisation and machine code."""

    def finalize(self) -> None:
        """Link the functions that this one calls."""
        for library in dict.fromkeys(self._linking_libraries):
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True


class _Called(_Library):
    """Machine code that callers find by its name."""

    def _get_module_for_linking(self) -> Any:
        """Return a module without code."""
        self._ensure_finalized()
        return llvm.parse_assembly(str(self._codegen._create_empty_module(self.name)))


def called(library: Any) -> dict[str, bytes]:
    """Return the machine code of each function that a library calls, by its symbol."""
    kept = vars(library)
    if "called" not in kept:
        found = {library.symbol: library._get_compiled_object()} if type(library) is _Called else {}
        for one in library._linking_libraries:
            found |= called(one)
        kept["called"] = found
    return kept["called"]


def load(context: Any, code: dict[str, bytes]) -> None:
    """Load the machine code of the functions that this process has not loaded."""
    engine = context.codegen()._engine
    for symbol, machine_code in code.items():
        if not engine.is_symbol_defined(symbol):
            engine._ee.add_object_file(llvm.ObjectFileRef.from_data(machine_code))
            engine._defined_symbols.add(symbol)


class _Lowering(typed_passes.NativeLowering):
    library: ClassVar[type[_Library]]

    def run_pass(self, state: Any) -> Literal[True]:
        context = state.targetctx
        state.library = self.library(context.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        state.flags.no_compile = True
        super().run_pass(state)
        state.library.symbol = state.cr.fndesc.llvm_func_name
        state.library.finalize()
        signature = Signature(state.return_type, state.args, recvr=None)
        state.cr = _result(context, state.library, state.cr.fndesc, state.cr.env, signature)
        context.insert_user_function(state.cr.entry_point, state.cr.fndesc, [state.library])
        return True


@register_pass(mutates_CFG=True, analysis_only=False)
class _InlinedLowering(_Lowering):
    _name = "inlined_lowering"
    library = _Inlined


@register_pass(mutates_CFG=True, analysis_only=False)
class _CalledLowering(_Lowering):
    _name = "called_lowering"
    library = _Called


class InlinedCompiler(compiler.CompilerBase):
    """Numba's compiler up to the code that other functions take in."""

    lowering: ClassVar[type[_Lowering]] = _InlinedLowering

    def define_pipelines(self) -> list[Any]:
        """Return the passes of Numba's compiler, the last one replaced."""
        passes = compiler.DefaultPassBuilder.define_nopython_pipeline(self.state).passes
        pipeline = PassManager("linked")
        for one, name in passes:
            if one is typed_passes.NativeLowering:
                pipeline.add_pass(self.lowering, name)
            elif one is not typed_passes.NoPythonBackend:
                pipeline.add_pass(one, name)
        pipeline.finalize()
        return [pipeline]


class CalledCompiler(InlinedCompiler):
    """Numba's compiler without the wrapper for Python."""

    lowering = _CalledLowering


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
    library = result.library
    code = library._get_module_for_linking().as_bitcode()
    own = result.fndesc, result.environment, result.signature
    return library.name, code, called(library), *own


def rebuild(context: Any, payload: tuple[Any, ...]) -> Any:
    """Return a compiled function from what `reduce` returned."""
    name, code, machine_code, *own = payload
    load(context, machine_code)
    library: Any = codegen.JITCodeLibrary(context.codegen(), name)
    library._final_module = library._shared_module = llvm.parse_bitcode(code)
    library.called = machine_code
    library._finalized = True
    return _result(context, library, *own)
