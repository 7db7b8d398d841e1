"""The house: imports go one way, outside libraries enter by their own doors, modules stay small."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "jaxfuzzy"
# Each module may import those before it, never those after it.
ORDER = """
    arrays status checks files linalg memberships tiles solve alternation blocks fcm embedding
    varietystep varietyresult varietyblocks varieties conditioning
    seeding validity density segment meshes primitives refine recover bodies simulate
    packing objects rays bounds starts local choice candidates screening finalists search polish fitting looks assembly mostpoints
    quadrics
    shapes trials joining dividing groups
    cloudfiles cloud planes ground rigfiles rigwriters rig reproject matcher photos calibrate brightness stereo render
    flecks steps outline pieces occlusion evidence rivals vertical patches naming scene
    losses tuning sensitivity drawing plot export folder page report table
    estimators arguments terminal
    cli __main__ __init__
""".split()
DOORS = {
    "cv2": {"brightness", "calibrate", "drawing", "flecks", "photos", "rigwriters", "steps", "stereo"},
    "optimistix": {"refine", "solve", "tuning"},
    "sklearn": {"estimators"},
    "matplotlib": {"plot"},
    "k3d": {"page"},
    "tqdm": {"terminal"},
}
CORE = {"jax", "jaxtyping", "numpy", "equinox", "chex", "optimistix", "cv2", "jaxfuzzy"}
MODULES = sorted(PACKAGE.glob("*.py"))


def imports(path):
    """Every (module, at top level) that a file imports, imports for type checking aside."""
    tree = ast.parse(path.read_text())
    guarded = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in guarded:
            continue
        top = node in tree.body
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, top
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} imports relatively"
            if node.module == "jaxfuzzy":
                for alias in node.names:
                    yield f"jaxfuzzy.{alias.name}", top
            else:
                yield str(node.module), top


def test_doors_are_used():
    """A door nobody goes through any more is shut."""
    through = {library: set() for library in DOORS}
    for path in MODULES:
        for name, _ in imports(path):
            if (root := name.split(".")[0]) in DOORS:
                through[root].add(path.stem)
    assert through == DOORS


def test_every_module_has_its_place():
    assert {path.stem for path in MODULES} - {"__main__"} <= set(ORDER)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_imports_go_one_way(path):
    place = ORDER.index(path.stem) if path.stem in ORDER else len(ORDER)
    for name, top in imports(path):
        parts = name.split(".")
        if parts[0] == "jaxfuzzy" and len(parts) > 1 and top:
            assert ORDER.index(parts[1]) < place, f"{path.name} imports {name}, which stands after it"
        root = parts[0]
        if root in DOORS:
            assert path.stem in DOORS[root], f"{path.name} imports {root}"
        if top:
            known = root in CORE or root in sys.stdlib_module_names or path.stem == "estimators"
            assert known, f"{path.name} imports {root} at top level"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_modules_are_small_and_say_what_they_are(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 450
    assert path.stem == "__init__" or ast.get_docstring(ast.parse(text))


def test_core_needs_no_extra():
    # In a process of its own: whatever this one has imported must not hide an import.
    code = (
        "import sys, jaxfuzzy, jaxfuzzy.cli, jaxfuzzy.report;"
        "bad = {'matplotlib', 'k3d', 'tqdm', 'sklearn', 'trimesh', 'scipy.spatial'} & set(sys.modules); assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# The contract of the top level: taking a name away must be deliberate.
PUBLIC = """
    Blocks Box Cloud ClusterCount Cone Cylinder DataError Hyper Influence Matcher NoiseRule Partition Plane Quadric Rig Scene
    Seeds Segmentation Shape Solver Sphere Status Tuned Varieties
    blocks calibrate choose_k cloud_from_depth cloud_from_disparity conditioning describe disparity example_pair fcm
    find_ground fit_shape fit_shapes fuzzy_silhouette histogram_seeds influence load_rig load_scene measure_noise memberships
    model_cloud model_scene nfcv partition_coefficient principal_axes read_cloud read_depth read_disparity reconstruct recover
    rectify save_rig segment tune upright variance_ratio write_cloud xie_beni
""".split()


def test_public_names_are_all_there_and_documented():
    import jaxfuzzy as jf

    for name in PUBLIC:
        assert getattr(jf, name).__doc__, name
    modules = type(jf)
    extra = {name for name, value in vars(jf).items() if name[0] != "_" and not isinstance(value, modules)} - set(
        PUBLIC
    )
    assert not extra


def test_nothing_outside_is_mentioned():
    root = PACKAGE.parent
    word = "sha" + "red"
    for path in [*PACKAGE.rglob("*.py"), root / "README.md", root / "CHANGELOG.md"]:
        assert f"../{word}" not in path.read_text(), path
