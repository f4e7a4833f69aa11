"""A kernel never runs stale code: an edit of a callee in another file is seen."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from numba import types

from softloop.plant import physics
from softloop.wire.kernel import kernel, new_record, record_dtype, record_type, source_hash, sources_of

INNER = record_dtype([("gain", "f8"), ("table", "f8", (3,))])
OUTER = record_dtype([("inner", INNER), ("n", "i8")])


@kernel(types.f8(record_type(OUTER), types.f8))
def scaled(outer, x):
    outer.n += 1
    outer.inner.table[1] = x
    return outer.inner.gain * x


def test_records_work_compiled_and_plain():
    a, b = new_record(OUTER), new_record(OUTER)
    a.inner.gain = b.inner.gain = 3.0
    assert scaled(a, 2.0) == scaled.py_func(b, 2.0) == 6.0
    assert a == b
    assert a.n == 1
    assert a.inner.table[1] == 2.0


def test_division_by_zero_is_as_in_numpy():
    @kernel(types.f8(types.f8, types.f8))
    def divide(a, b):
        return a / b

    assert np.isinf(divide(1.0, 0.0))
    assert np.isnan(divide(0.0, 0.0))


def test_the_hash_sees_all_that_a_module_reaches_and_nothing_else(tmp_path):
    one, two, three, four = (tmp_path / f"{name}.py" for name in ("one", "two", "three", "four"))
    one.write_text("from two import (\n    x,\n    y,\n)\n")
    two.write_text("def f():\n    import three\n\nx = y = 1")
    three.write_text("z = 1")
    four.write_text("w = 1")
    before = source_hash(sources_of(one, tmp_path))
    assert source_hash(sources_of(one, tmp_path)) == before
    four.write_text("w = 2")
    assert source_hash(sources_of(one, tmp_path)) == before
    three.write_text("z = 2")
    assert source_hash(sources_of(one, tmp_path)) != before


def test_a_kernel_reaches_callees_in_other_rooms_and_the_messages():
    reached = {path.name for path in sources_of(Path(physics.__file__))}
    assert {"physics.py", "air.py", "gas.py", "PlantTruth.msg", "kernel.py"} <= reached
    assert "recorder.py" not in reached


CALLER = """
import sys; sys.path.insert(0, {folder!r})
import os; os.environ["XDG_CACHE_HOME"] = {folder!r}
import caller
print(caller.outer(1.0))
"""


def test_an_edited_callee_in_another_file_is_seen(tmp_path):
    (tmp_path / "caller.py").write_text(
        "from numba import types\nfrom callee import inner\nfrom softloop.wire.kernel import kernel\n"
        "@kernel(types.f8(types.f8))\ndef outer(x):\n    return inner(x) + 1.0\n"
    )

    def run(factor):
        (tmp_path / "callee.py").write_text(
            "from numba import types\nfrom softloop.wire.kernel import kernel\n"
            f"@kernel(types.f8(types.f8))\ndef inner(x):\n    return {factor} * x\n"
        )
        os.utime(tmp_path / "callee.py", (1, 1))  # not even the time of change may be needed
        script = CALLER.format(folder=str(tmp_path))
        done = subprocess.run([sys.executable, "-B", "-c", script], capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
        return float(done.stdout)

    assert run(2.0) == 3.0
    assert run(2.0) == 3.0
    assert run(5.0) == 6.0
