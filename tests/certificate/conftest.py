"""A certificate that many tests look at."""

import pytest

from bench.certificate.content import Certificate, Issue
from bench.certificate.gather import certificate_of
from bench.certificate.laboratory import load_laboratory, load_order
from tests.support.certificates import ORDER, copy_run, write_files


@pytest.fixture(scope="session")
def issued_certificate(tmp_path_factory: pytest.TempPathFactory) -> Certificate:
    """A certificate of the recorded run with a number, in two languages."""
    folder = tmp_path_factory.mktemp("issued")
    copy_run(folder / "runs")
    laboratory_file, order_file = write_files(folder, {"language": ["en", "de"]}, ORDER)
    laboratory = load_laboratory(laboratory_file)
    issue = Issue(
        "SIM-2026-0001",
        "2026-11-22T12:00:00+00:00",
        laboratory.authorised[0],
        signed_by="Laboratory of Tests",
    )
    return certificate_of("finished", folder / "runs", laboratory, load_order(order_file), issue)
