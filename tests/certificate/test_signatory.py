"""Who may sign: files and tokens of keys, their certificates, and what is refused of them."""

import os
import shutil
import stat
import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa

from bench.certificate.signatory import (
    certificates_in,
    fingerprint_of,
    new_certificate_key,
    signatory_of,
    why_not_trusted,
)
from bench.certificate.signatures import check_pdf, check_xml, sign_pdf, sign_xml
from bench.run.events import RecordError
from bench.services.errors import Refused
from tests.support.signed import NOW, authority, blank_pdf, certified, in_file, no_passphrase

XML = b"<a><b>1</b></a>"
SOFTHSM = next(
    (
        path
        for path in (Path("/usr/lib/softhsm/libsofthsm2.so"), Path("/usr/lib64/softhsm/libsofthsm2.so"))
        if path.is_file()
    ),
    None,
)


def signed_both(signatory):
    """Sign XML and PDF; return the chains that checking them finds."""
    xml = check_xml(sign_xml(XML, signatory, NOW))
    pdf = check_pdf(sign_pdf(blank_pdf(), signatory, NOW, "", ""))
    assert xml.signed_at == pdf.signed_at == NOW
    return xml.chain, pdf.chain


def test_a_new_key_signs_and_its_own_certificate_stands_for_it(bench):
    status, out, _ = bench(
        "key", "keys/cert.pem", "--certificate", "Laboratory of Tests", "--passphrase", stdin="w\nw\n"
    )
    assert status == 0
    assert stat.S_IMODE(Path("keys/cert.pem").stat().st_mode) == 0o600
    (own,) = certificates_in(Path("keys/cert.pem.crt"))
    assert fingerprint_of(own) in out
    now = datetime.now(UTC)
    signatory = signatory_of("keys/cert.pem", None, lambda: b"w", now)
    assert signatory.name == "Laboratory of Tests"
    chain = check_xml(sign_xml(XML, signatory, now)).chain
    assert why_not_trusted(chain, now, [own]) == ""
    assert "not valid at the time" in why_not_trusted(chain, now + timedelta(days=4000), [own])
    with pytest.raises(RecordError, match="a wrong passphrase"):
        signatory_of("keys/cert.pem", None, lambda: b"x", now)
    assert "a file of that name exists" in bench("key", "keys/cert.pem", "--certificate", "L")[2]
    assert "1 to 64" in bench("key", "keys/other.pem", "--certificate", "L" * 65)[2]


@pytest.mark.skipif(os.name != "posix", reason="modes of files are POSIX's")
def test_a_key_that_others_may_read_does_not_sign(tmp_path):
    file = tmp_path / "keys" / "cert.pem"
    new_certificate_key(file, "L", None, NOW)
    file.chmod(0o640)
    with pytest.raises(RecordError, match="chmod 600"):
        signatory_of(str(file), None, no_passphrase, NOW)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["P-384", "RSA"])
def test_a_chain_of_a_laboratory_stands_for_it_by_its_root_alone(tmp_path, kind):
    key = (
        ec.generate_private_key(ec.SECP384R1()) if kind == "P-384" else rsa.generate_private_key(65537, 2048)
    )
    root, middle = authority("Root"), authority("Middle", "Root")
    leaf = certified(key.public_key(), "Laboratory", middle)
    signatory = in_file(tmp_path, key, [leaf, middle.certificate])
    for chain in signed_both(signatory):
        assert chain[0] == leaf
        assert why_not_trusted(chain, NOW, [root.certificate]) == ""
        assert why_not_trusted(chain, NOW, [leaf]) == ""
        assert why_not_trusted(chain, NOW, [authority("Another").certificate]) != ""
        assert why_not_trusted(chain, NOW + timedelta(days=400), [root.certificate]) != ""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"subject_key": True}, "to another key"),
        ({"until": NOW - timedelta(days=1)}, "not now"),
        ({"usage": False}, "excludes signatures"),
        ({"chain": "Another"}, "was not issued by"),
        ({"key": rsa.generate_private_key(65537, 1024)}, "1024 bits"),  # noqa: S505
    ],
)
def test_a_certificate_that_cannot_stand_for_the_key_is_refused(tmp_path, change, words):
    key = change.get("key") or ec.generate_private_key(ec.SECP256R1())
    subject = ec.generate_private_key(ec.SECP256R1()) if "subject_key" in change else key
    root = authority("Root")
    leaf = certified(
        subject.public_key(),
        "L",
        root,
        until=change.get("until", NOW + timedelta(days=9)),
        sign=change.get("usage", True),
    )
    above = authority(change["chain"]) if "chain" in change else root
    with pytest.raises(Refused, match=words):
        in_file(tmp_path, key, [leaf, above.certificate])


def test_what_is_no_key_for_certificates_is_told(bench, tmp_path):
    bench("key", "keys/seal.pem")
    with pytest.raises(Refused, match="cannot sign certificates"):
        signatory_of("keys/seal.pem", None, no_passphrase, NOW)
    bench("key", "keys/cert.pem", "--certificate", "L")
    Path("keys/cert.pem.crt").unlink()
    with pytest.raises(Refused, match="its chain with"):
        signatory_of("keys/cert.pem", None, no_passphrase, NOW)
    Path("none.crt").write_text("nothing")
    with pytest.raises(Refused, match=r"no X\.509 certificate"):
        certificates_in(Path("none.crt"))


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("pkcs11:token=a?module-path=/m", "token=a: 'object' or 'id' is missing;"),
        ("pkcs11:object=a", "object=a: 'module-path' is missing after"),
        ("pkcs11:object=a;pin=1?module-path=/m", "'pin' is not allowed"),
        (
            "pkcs11:object=a?module-path=/m&pin-value=1",
            "'pin-value' is not allowed after .*the program asks for the PIN",
        ),
        ("pkcs11:object=a?module-path=/nowhere/module.so", r"module|no key"),
    ],
)
def test_an_address_in_a_token_names_one_key_and_no_pin(address, words):
    pytest.importorskip("pkcs11")
    with pytest.raises(Refused, match=words):
        signatory_of(address, None, lambda: b"1234", NOW)


@pytest.fixture
def token(tmp_path, monkeypatch):
    """A token of SoftHSM named `bench`, with the PIN 1234; return the module's path."""
    pkcs11 = pytest.importorskip("pkcs11", reason="python-pkcs11 is not installed")
    if SOFTHSM is None or shutil.which("softhsm2-util") is None:
        pytest.skip("SoftHSM is not on this machine")
    (tmp_path / "tokens").mkdir()
    (tmp_path / "softhsm.conf").write_text(f"directories.tokendir = {tmp_path / 'tokens'}\n")
    monkeypatch.setenv("SOFTHSM2_CONF", str(tmp_path / "softhsm.conf"))
    made = [
        "softhsm2-util",
        "--init-token",
        "--free",
        "--label",
        "bench",
        "--so-pin",
        "1234",
        "--pin",
        "1234",
    ]
    subprocess.run(made, check=True, capture_output=True)  # noqa: S603
    library = pkcs11.lib(str(SOFTHSM))
    library.reinitialize()
    return library.get_token(token_label="bench")  # noqa: S106


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["P-256", "RSA"])
def test_a_key_that_never_leaves_its_token_signs(token, kind):
    import pkcs11
    from cryptography.hazmat.primitives.serialization import Encoding, load_der_public_key
    from pkcs11.util.ec import encode_ec_public_key, encode_named_curve_parameters
    from pkcs11.util.rsa import encode_rsa_public_key

    with token.open(rw=True, user_pin="1234") as session:
        if kind == "RSA":
            public, private = session.generate_keypair(pkcs11.KeyType.RSA, 2048, label="lab", store=True)
            der = encode_rsa_public_key(public)
            from asn1crypto.keys import PublicKeyInfo, RSAPublicKey

            der = PublicKeyInfo.wrap(RSAPublicKey.load(der), "rsa").dump()
        else:
            curve = session.create_domain_parameters(
                pkcs11.KeyType.EC,
                {pkcs11.Attribute.EC_PARAMS: encode_named_curve_parameters("secp256r1")},
                local=True,
            )
            public, private = curve.generate_keypair(label="lab", store=True)
            der = encode_ec_public_key(public)
        assert private[pkcs11.Attribute.SENSITIVE]
        assert not private[pkcs11.Attribute.EXTRACTABLE]
        root = authority("Root")
        leaf = certified(load_der_public_key(der), "In a token", root)
        session.create_object(
            {
                pkcs11.Attribute.CLASS: pkcs11.ObjectClass.CERTIFICATE,
                pkcs11.Attribute.CERTIFICATE_TYPE: pkcs11.CertificateType.X_509,
                pkcs11.Attribute.TOKEN: True,
                pkcs11.Attribute.LABEL: "lab",
                pkcs11.Attribute.SUBJECT: leaf.subject.public_bytes(),
                pkcs11.Attribute.VALUE: leaf.public_bytes(Encoding.DER),
            }
        )
    address = f"pkcs11:token=bench;object=lab?module-path={SOFTHSM}"
    for given, wrong, words in (("=lab", "=none", "private keys.*: 0"), ("=bench", "=none", "gave no key")):
        with pytest.raises(Refused, match=words):
            signatory_of(address.replace(given, wrong), None, lambda: b"1234", NOW)
    for chain in signed_both(signatory_of(address, None, lambda: b"1234", NOW)):
        assert why_not_trusted(chain, NOW, [root.certificate]) == ""


def test_a_wrong_pin_is_told(token):
    with pytest.raises(Refused, match="connected and its PIN"):
        signatory_of(f"pkcs11:token=bench;object=lab?module-path={SOFTHSM}", None, lambda: b"4321", NOW)
