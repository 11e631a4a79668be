"""Our own rules find what is wrong with a document; so do schemas, where somebody has them."""

import pytest

from bench.certificate.dcc.document import document_of
from bench.certificate.dcc.rules import against_schemas, broken_rules, read_schemas
from bench.services.errors import Refused

SCHEMA = (
    '<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" version="{}" targetNamespace="{}" {}</xs:schema>'
)


@pytest.fixture(scope="module")
def document(issued_certificate):
    return document_of(issued_certificate).decode()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("<dcc:issueDate>2026-11-22", "<dcc:issueDate>2026-11-01", "not in this order"),
        ('schemaVersion="3.3.0"', 'schemaVersion="3.2.0"', "not a DCC 3.3.0"),
        ("<dcc:uniqueIdentifier>SIM-", "<dcc:uniqueIdentifier>", "of simulated runs, and say so"),
        ('<dcc:content lang="de">Ergebnisse</dcc:content>', "", "not in all languages used"),
        ("<si:coverageFactorXMLList>2.0 ", "<si:coverageFactorXMLList>3.0 ", "U is not k times"),
        ("Kxx Kxy Kxz", "Kxx Kxy", "12 values, but 11 in labelXMLList"),
        (r"<si:unitXMLList>\volt \volt ", r"<si:unitXMLList>\volt ", "12 values, but 11 units"),
        (r"<si:unitXMLList>\volt \volt ", r"<si:unitXMLList>\vold \volt ", "vold is unknown"),
        ("<dcc:conformityXMLList>", "<dcc:conformityXMLList>pass ", "not a statement for each value"),
        ("<dcc:items>", "<!-- so --><dcc:items>", "which no signature covers"),
        ("<dcc:items>", "<dcc:items><x/>", "not in the name space of a DCC"),
    ],
)
def test_a_broken_rule_is_told(document, old, new, told):
    assert old in document
    broken = broken_rules(document.replace(old, new, 1).encode())
    assert any(told in text for text in broken), broken


def test_a_covariance_that_is_none_is_told(document):
    start = document.index("<si:covarianceMatrixXMLList>")
    first = document.index("<si:valueXMLList>", start) + len("<si:valueXMLList>")
    end = document.index(" ", first)
    for value, told in (
        ("-1e-9", "negative variance"),
        ("1e-9 1e-9", "a covariance of"),
        ("1e-30", "not symmetric"),
    ):
        broken = broken_rules((document[:first] + value + document[end:]).encode())
        assert any(told in text for text in broken), broken


def test_what_is_no_xml_and_what_would_fetch_something_is_told():
    assert "not XML" in broken_rules(b"<a>")[0]
    outside = b'<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>'
    assert not any("root:" in text for text in broken_rules(outside))


def test_schemas_of_the_user_are_checked_against(tmp_path, document):
    (tmp_path / "deep").mkdir()
    (tmp_path / "SI_Format.xsd").write_text(SCHEMA.format("2.2.1", "https://ptb.de/si", ">"))
    content = (
        'xmlns:ds="http://www.w3.org/2000/09/xmldsig#"><xs:import namespace="https://ptb.de/si" '
        'schemaLocation="https://ptb.de/si/SI_Format.xsd"/><xs:import '
        'namespace="http://www.w3.org/2000/09/xmldsig#" schemaLocation="https://x/xmldsig-core-schema.xsd"/>'
        '<xs:element name="digitalCalibrationCertificate"><xs:complexType><xs:sequence>'
        '<xs:any namespace="https://ptb.de/dcc" processContents="skip" maxOccurs="{}"/>'
        '<xs:element ref="ds:Signature" minOccurs="0"/></xs:sequence>'
        '<xs:anyAttribute processContents="skip"/></xs:complexType></xs:element>'
    )
    place = tmp_path / "deep" / "dcc.xsd"
    for most, wrong in ((2, 0), (1, 1)):
        place.write_text(SCHEMA.format("3.3.0", "https://ptb.de/dcc", content.format(most)))
        schemas = read_schemas(tmp_path)
        assert len(against_schemas(schemas, document.encode())) == wrong


def test_schemas_of_another_version_or_none_are_refused(tmp_path):
    with pytest.raises(Refused, match=r"the folder has no dcc\.xsd"):
        read_schemas(tmp_path)
    (tmp_path / "dcc.xsd").write_text(SCHEMA.format("3.2.0", "https://ptb.de/dcc", ">"))
    with pytest.raises(Refused, match=r"version 3\.2\.0"):
        read_schemas(tmp_path)
