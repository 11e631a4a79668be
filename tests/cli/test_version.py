"""`bench --version`: which program this is."""

import subprocess
import sys
from importlib import metadata


def test_the_version_is_that_of_the_distribution(bench):
    assert bench("--version") == (0, f"bench {metadata.version('triaxial-bench')}\n", "")


def test_a_command_is_not_carried_out_beside_it(bench):
    status, out, err = bench("--version", "run", "paper", "--dry-run")
    assert (status, err) == (0, "")
    assert out.count("\n") == 1


def test_the_program_looks_its_version_up_only_when_it_is_asked():
    program = (
        "import sys\n"
        "from bench.cli.app import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "assert 'importlib.metadata' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - our own program
