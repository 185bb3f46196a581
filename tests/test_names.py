"""The public contract: names and signatures are pinned, importing them costs nothing until they are
used, their docstrings' examples run and name every argument, and the exceptions make a tree.
"""

import ast
import dataclasses
import doctest
import importlib
import inspect
import io
import pkgutil
import re
import subprocess
import sys
import typing
from pathlib import Path

import pytest

from tofclip import errors

ROOTS = ("tofclip", "nlos", "devices")
ROOT = Path(errors.__file__).parents[1]
GOLDEN = Path(__file__).parent / "golden" / "names.txt"
API_PAGES = ROOT / "docs" / "api"
CONTRACT = (
    *("tofclip.read_streak", "tofclip.recover", "tofclip.depth", "tofclip.point_cloud"),
    *("tofclip.nmse", "tofclip.load", "tofclip.recovery.open_shot"),
    *("tofclip.Camera", "tofclip.Frames", "tofclip.PointCloud"),
    *("nlos.Capture", "nlos.Grid", "nlos.Volume", "nlos.settings_for"),
    *("nlos.Hybrid", "nlos.PlanarRSD", "nlos.Backprojection", "nlos.FilteredBackprojection"),
    *("nlos.LightCone", "nlos.FKMigration", "devices.open", "devices.discover"),
)
"""Names that users write most: their arguments are held too, and the members of the classes."""

MEASURED = (
    *("tofclip.solvers.Sparse", "tofclip.solvers.TotalVariation", "tofclip.solvers.Wavelets"),
    *("tofclip.solvers.LinearInverse", "tofclip.solvers.fista.LightFieldVariation"),
    *("tofclip.solvers.PlugAndPlay", "tofclip.solvers.RegularisationByDenoising"),
    "tofclip.solvers.denoising.NonlocalMeans",
    "tofclip.solvers.denoising.CollaborativeWiener",
    *("tofclip.lidar.Detection", "tofclip.lidar.photons.PhotonDetector"),
    "tofclip.simulate.StreakDetector",
    *("tofclip.recovery.SurfaceRecovery", "tofclip.recovery.DepthLockedFocus"),
    *("tofclip.recovery.FixedFocus", "nlos.Refinement", "nlos.refinement.l1.build_total_variation"),
    "nlos.refinement.photons.PhotonRefinement",
)
"""Of these the defaults are held: who changes one measures it anew, and says so where docs/recovery_algorithm.md,
docs/nlos.md, docs/nlos_algorithm.md or docs/results speak of it.
"""

OF_METHODS = ("plan", "reconstruct")
"""The members that are held of a method of imaging around corners."""
HEAVY = {"h5py", "matplotlib", "numba", "numpy", "open3d", "pyvista", "scipy", "tifffile"}


def list_packages():
    for root in ROOTS:
        home = importlib.import_module(root)
        yield root
        for item in pkgutil.walk_packages(home.__path__, f"{root}."):
            if item.ispkg:
                yield item.name


def show_signature(value):
    """Names, kinds and defaults of arguments; types may be put more exactly."""
    plain, fields = inspect.signature(value), getattr(value, "__dataclass_fields__", {})
    shown = [one.replace(annotation=inspect.Parameter.empty) for one in plain.parameters.values()]
    for number, one in enumerate(shown):
        if repr(one.default) == "<factory>":
            made = fields[one.name].default_factory()
            if dataclasses.is_dataclass(made):
                shown[number] = one.replace(default=made)
    text = str(plain.replace(parameters=shown, return_annotation=inspect.Signature.empty))
    return re.sub(r"<(?:function|class) '?([\w.]+)[^>]*>", r"\1", text)


def list_members(name, home):
    """A class's public methods and properties, inherited ones of this project included."""
    for one in OF_METHODS if hasattr(home, "reconstruct") else sorted(dir(home)):
        owner = next((base for base in home.__mro__ if one in vars(base)), object)
        if one[0] == "_" or not owner.__module__.startswith(ROOTS):
            continue
        member = inspect.getattr_static(home, one)
        function = getattr(home, one) if callable(getattr(home, one)) else None
        is_method = isinstance(member, staticmethod | classmethod) or inspect.isfunction(member)
        yield f"{name}.{one}{show_signature(function) if is_method else ''}"


def list_names():
    """What every package exports, then the contract in full, and what else has measured defaults."""
    for package in list_packages():
        module = importlib.import_module(package)
        for name in sorted(getattr(module, "__all__", ())):
            assert name in dir(module)
            assert getattr(module, name) is not None
            yield f"{package}.{name}"
    for name in (*CONTRACT, *MEASURED):
        package, _, one = name.rpartition(".")
        value = getattr(importlib.import_module(package), one)
        yield f"{name}{show_signature(value)}"
        if inspect.isclass(value) and name in CONTRACT:
            yield from list_members(name, value)


def test_public_names_and_signatures_are_those_of_the_file():
    made, kept = [*list_names()], GOLDEN.read_text("utf-8").splitlines()
    changed = [f"lost  {line}" for line in kept if line not in made]
    changed += [f"new   {line}" for line in made if line not in kept]
    assert not changed, "\n".join([f"against tests/golden/{GOLDEN.name}:", *changed])


@pytest.mark.parametrize("module", ROOTS)
def test_a_list_of_names_shows_the_public_ones_only(module):
    home = importlib.import_module(module)
    assert dir(home) == sorted(home.__all__)
    with pytest.raises(AttributeError, match="lidar_magic"):
        _ = home.lidar_magic


@pytest.mark.parametrize(
    ("modules", "light"),
    [
        ("tofclip, nlos", set()),
        # Reading has to be quick: no compiler and no plotting library is needed for it.
        ("tofclip.io", {"numpy"}),
    ],
)
def test_importing_the_packages_imports_nothing_heavy(modules, light):
    code = f"import sys, {modules}; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    loaded = set(done.stdout.split())
    assert set(modules.split(", ")) <= loaded
    assert not (HEAVY - light) & loaded


def public_names():
    """What packages list in ``__all__`` and what the pages of the API document, by full name."""
    found = {}
    for package in list_packages():
        module = importlib.import_module(package)
        found |= {
            f"{package}.{name}": getattr(module, name) for name in getattr(module, "__all__", ())
        }
    text = "".join(page.read_text("utf-8") for page in API_PAGES.glob("*.md"))
    for name in re.findall(r"automodule:: (\S+)", text):
        module = importlib.import_module(name)
        own = [
            one for one, value in vars(module).items() if getattr(value, "__module__", "") == name
        ]
        for one in getattr(module, "__all__", own):
            if not one.startswith("_"):
                found[f"{name}.{one}"] = getattr(module, one)
    for name in re.findall(r"auto(?:class|function):: (\S+)", text):
        module, _, one = name.rpartition(".")
        found[name] = getattr(importlib.import_module(module), one)
    return found


def list_examples():
    """Of all public names, each once: many are listed in several places."""
    found = {}
    for name, value in public_names().items():
        if str(getattr(value, "__module__", "")).startswith(ROOTS):
            for test in doctest.DocTestFinder().find(value, name):
                found[test.filename, test.lineno] = test
    yield from (test for test in found.values() if test.examples)


def test_examples_do_what_they_say():
    """And of those that need a file of one's own, what they import and call is there."""
    tests = [*list_examples()]
    assert len(tests) > 10
    for test in tests:
        trouble = io.StringIO()
        doctest.DocTestRunner().run(test, out=trouble.write, clear_globs=False)
        assert not trouble.getvalue()
        for example in test.examples:
            if doctest.SKIP not in example.options:
                continue
            for node in ast.walk(ast.parse(example.source)):
                if isinstance(node, ast.Import | ast.ImportFrom):
                    exec(ast.unparse(node), test.globs)
                elif isinstance(node, ast.Call):
                    assert callable(eval(ast.unparse(node.func), test.globs)), test.name


def list_signatures(name, value):
    """The annotated things that a public name consists of: itself, and a class's public methods."""
    if inspect.isclass(value) or inspect.isfunction(value):
        yield name, value
    if inspect.isclass(value):
        for own, member in vars(value).items():
            function = (
                member.fget if isinstance(member, property) else getattr(member, "__func__", member)
            )
            if inspect.isfunction(function) and (own in ("__init__", "__call__") or own[0] != "_"):
                yield f"{name}.{own}", function


def list_parts(annotation):
    """A type and all that it is made of."""
    yield annotation
    for part in typing.get_args(annotation):
        yield from (
            (one for item in part for one in list_parts(item))
            if isinstance(part, list)
            else list_parts(part)
        )


def list_signature_types(names):
    """Types of our own in the signatures of public names, each with the place where it stands."""
    # For annotations that are imported for the type checker only.
    by_name = {name.rpartition(".")[2]: value for name, value in names.items()}
    by_name |= {name: importlib.import_module(name) for name in ("h5py", "scipy")}
    for name, value in names.items():
        if not str(getattr(value, "__module__", "")).startswith(ROOTS):
            continue
        for where, item in list_signatures(name, value):
            own = vars(sys.modules[item.__module__])
            scope = {key: one for key, one in by_name.items() if key not in own}
            hints = typing.get_type_hints(item, localns=scope)
            for one in (part for hint in hints.values() for part in list_parts(hint)):
                if isinstance(one, type) and one.__module__.startswith(ROOTS):
                    yield where, one


def test_every_type_in_a_public_signature_can_be_imported_from_a_public_place():
    names = public_names()
    public = {id(value) for value in names.values()}
    found = [*list_signature_types(names)]
    hidden = {
        f"{one.__module__}.{one.__qualname__}": where
        for where, one in found
        if id(one) not in public
    }
    assert len(found) > 700
    assert not hidden


# Sections of docstrings stand where users read them, and only there: in the names that packages
# export, what their signatures take and return, and the public methods of these.
SECTION = re.compile(
    r"^ *(Parameters|Returns|Yields|Raises|Attributes|Notes|See Also)\n *-{3,}", re.M
)


@pytest.fixture(scope="module")
def public():
    """Public names by the place where they are defined."""
    packages, names = set(list_packages()), public_names()
    exported = {name: one for name, one in names.items() if name.rpartition(".")[0] in packages}
    reached = [
        one
        for where, one in list_signature_types(names)
        if where in exported or where.rpartition(".")[0] in exported
    ]
    found = [one for one in (*exported.values(), *reached) if hasattr(one, "__qualname__")]
    return {f"{one.__module__}.{one.__qualname__}": one for one in found}


def list_docstrings():
    """Every docstring with the full name that it belongs to."""
    for path in (
        path for package in (*ROOTS, "apps") for path in sorted((ROOT / package).rglob("*.py"))
    ):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        yield from walk(ast.parse(path.read_text("utf-8")), module)


def walk(node, name):
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    if isinstance(node, documented):
        yield name, ast.get_docstring(node) or ""
    for child in ast.iter_child_nodes(node):
        own = f"{name}.{child.name}" if isinstance(child, documented[1:]) else name
        yield from walk(child, own)


def is_public(name, public):
    """A public name, or a method of one that is not private."""
    home, _, own = name.rpartition(".")
    return name in public or (home in public and (own[0] != "_" or own.startswith("__")))


def test_sections_stand_in_public_names_only(public):
    wrong = [
        name
        for name, text in list_docstrings()
        if SECTION.search(text) and not is_public(name, public)
    ]
    assert not wrong, f"{len(wrong)}: {', '.join(wrong[:20])}, ..."


BOUND = ("self", "cls")


def list_undocumented(name, value):
    """Arguments in no Parameters section and no sentence; a class describes its fields anywhere."""
    if inspect.isclass(value):
        described = inspect.getdoc(value) or ""
        functions = {own: one for own, one in vars(value).items() if own[0] != "_"}
        functions = {own: getattr(one, "__func__", one) for own, one in functions.items()}
        own_fields = "\n".join(filter(None, (inspect.getdoc(base) for base in value.__mro__[:-1])))
        fields = getattr(value, "__dataclass_fields__", {})
        yield from (
            f"{name}({field})"
            for field, one in fields.items()
            if one.init
            and field[0] != "_"
            and not re.search(rf"\b{field}\b", described + own_fields)
        )
    else:
        functions = {"": value}
    for own, function in functions.items():
        if not inspect.isfunction(function):
            continue
        text = inspect.getdoc(function) or ""
        if own and inspect.isclass(value):  # what a base says holds for what overrides it
            bases = (inspect.getdoc(getattr(base, own, None)) or "" for base in value.__mro__)
            text = "\n".join(bases)
        arguments = [one for one in inspect.signature(function).parameters if one not in BOUND]
        # ``load(path)``: the sentence is about it; and what another place says is not said again
        if len(arguments) == 1 or re.search(r"\b(see|as|as for)\s+(`|a matt)", text, re.I):
            continue
        for one in arguments:
            if not re.search(rf"\b{one}\b", text):
                yield f"{name}{'.' * bool(own)}{own}({one})"


def test_every_argument_of_a_public_name_is_in_its_docstring(public):
    packages = set(list_packages())
    exported = [one for name, one in public_names().items() if name.rpartition(".")[0] in packages]
    missing = [
        line
        for name, value in public.items()
        if (inspect.isclass(value) or inspect.isfunction(value)) and value in exported
        for line in list_undocumented(name, value)
    ]
    assert not missing, f"{len(missing)}: {', '.join(missing[:40])}, ..."


TREE = {
    "TofclipError": (Exception,),
    "InputError": (errors.TofclipError, ValueError),
    "ShapeError": (errors.InputError,),
    "CalibrationError": (errors.InputError,),
    "MissingTimeAxisError": (errors.InputError,),
    "FileFormatError": (errors.TofclipError, ValueError),
    "StorageError": (errors.TofclipError, OSError),
    "MissingDependencyError": (errors.TofclipError, ImportError),
    "DeviceError": (errors.TofclipError, OSError),
    "UsbBackendError": (errors.DeviceError,),
    "DeviceNotFoundError": (errors.DeviceError,),
    "DevicePermissionError": (errors.DeviceError,),
    "DeviceBusyError": (errors.DeviceError,),
    "DeviceTimeoutError": (errors.DeviceError, TimeoutError),
    "DeviceStalledError": (errors.DeviceError,),
    "DeviceDisconnectedError": (errors.DeviceError,),
    "TransferOverflowError": (errors.DeviceError,),
    "BufferOverflowError": (errors.DeviceError,),
    "ProtocolError": (errors.DeviceError,),
}


def test_the_tree_of_exceptions():
    classes = {name: one for name, one in vars(errors).items() if inspect.isclass(one)}
    faults = {name: one for name, one in classes.items() if issubclass(one, Exception)}
    assert {name: fault.__bases__ for name, fault in faults.items()} == TREE
    assert all(name in errors.__doc__ for name in TREE)


def test_messages_say_what_and_where():
    fault = errors.ShapeError("frames", (2, 3), (3, 2))
    assert str(fault) == "frames must have shape (2, 3), got (3, 2)"
    fault = errors.FileFormatError("shot.tif", "is empty")
    assert str(fault) == "shot.tif: is empty"
    assert fault.path == Path("shot.tif")
