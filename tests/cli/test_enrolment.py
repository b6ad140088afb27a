"""The authority of a plant and a newcomer, with all that may go wrong between them."""

import asyncio
import fcntl
import json
import ssl
import stat
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from http.client import HTTPSConnection
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from gateway.cli.certificates import enrolment, signing
from gateway.cli.certificates.authority import Authority, create
from gateway.cli.certificates.code import Code
from gateway.cli.certificates.serving import MOST_TRIES, serve
from gateway.cli.certificates.signing import Holder
from gateway.cli.certificates.state import sweep
from gateway.contract.access.certificates import expires
from gateway.errors import ConfigError, GatewayError, NotAllowed
from tests.zenoh_peer import free_port

HOUR = 3600.0
DUE = 0.01  # days: with the hour before, such a certificate is in its last third at once


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    create(tmp_path / "pki", 3650)
    made = Authority(tmp_path / "pki")
    made.serve_at(f"127.0.0.1:{free_port()}")
    return made


@asynccontextmanager
async def served(authority: Authority, listen: str = "") -> AsyncIterator[None]:
    """Serves meanwhile."""
    at = listen or authority.state().at
    serving = asyncio.create_task(serve(authority, "", at))
    host, _, port = at.rpartition(":")
    try:
        while not serving.done():
            try:
                _, writer = await asyncio.open_connection(host, int(port))
                writer.close()
                break
            except ConnectionRefusedError:
                await asyncio.sleep(0.02)
        yield
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


def post(authority: Authority, path: str, sent: object) -> tuple[int, bytes]:
    host, _, port = authority.state().at.rpartition(":")
    context = ssl.create_default_context(cafile=authority.folder / "ca.pem")
    connection = HTTPSConnection(host, int(port), timeout=30, context=context)
    body = sent if isinstance(sent, bytes) else json.dumps(sent).encode()
    try:
        connection.request("POST", path, body)
        reply = connection.getresponse()
        return reply.status, reply.read()
    finally:
        connection.close()


def enrolled(authority: Authority, name: str, days: float = 90) -> tuple[bytes, signing.PrivateKey]:
    code, key = authority.invite(Holder(name), days, HOUR), signing.new_key()
    return authority.enrol(name, code.secret, signing.request_for(name, key)), key


async def test_a_newcomer_gets_a_certificate_for_a_key_that_stays_with_it(
    authority: Authority, tmp_path: Path
) -> None:
    code = authority.invite(Holder("hall", ["gateway.plant", "10.0.0.5"]), 90, HOUR)
    async with served(authority):
        found = await asyncio.to_thread(enrolment.enrol, tmp_path / "hall", code)
        again = await asyncio.to_thread(enrolment.renew, tmp_path / "hall")
    assert again == (found, False)
    certificate = signing.certificate_of(found.certificate.read_bytes())
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["gateway.plant", "localhost"]
    assert [str(one) for one in names.get_values_for_type(x509.IPAddress)] == [
        *("10.0.0.5", "127.0.0.1", "::1")
    ]
    assert 89.9 < (certificate.not_valid_after_utc - datetime.now(UTC)).total_seconds() / 86400 < 91
    assert signing.is_issued_by(certificate, signing.certificate_of(found.ca.read_bytes()))
    secret = found.key.read_bytes()
    for file in (*authority.folder.iterdir(), *found.key.parent.iterdir()):
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert (secret in file.read_bytes()) == (file == found.key)
    assert stat.S_IMODE(authority.folder.stat().st_mode) == 0o700


async def test_a_code_is_good_for_one_key_and_as_often_as_that_key_asks(
    authority: Authority, tmp_path: Path
) -> None:
    """A newcomer that was killed after the authority had signed begins again."""
    code = authority.invite(Holder("hall"), 90, HOUR)
    key, other = signing.new_key(), signing.new_key()
    first = authority.enrol("hall", code.secret, signing.request_for("hall", key))
    assert authority.enrol("hall", code.secret, signing.request_for("hall", key)) == first
    with pytest.raises(NotAllowed, match="used by another program"):
        authority.enrol("hall", code.secret, signing.request_for("hall", other))
    assert len(authority.state().names["hall"].serials) == 1


async def test_of_two_newcomers_with_one_code_at_once_one_wins(
    authority: Authority, tmp_path: Path
) -> None:
    code = authority.invite(Holder("hall"), 90, HOUR)
    async with served(authority):
        answers = await asyncio.gather(
            *(
                asyncio.to_thread(enrolment.enrol, tmp_path / str(number), code)
                for number in range(6)
            ),
            return_exceptions=True,
        )
    won = [one for one in answers if not isinstance(one, BaseException)]
    lost = {str(one) for one in answers if isinstance(one, BaseException)}
    assert len(won) == 1
    assert [one.partition(" refuses: ")[2] for one in lost] == [
        "this code was used by another program: revoke its name"
    ]


def test_nothing_of_a_request_counts_but_its_key(authority: Authority) -> None:
    """Another name, another address, and an authority that the request wants to be."""
    code, key = authority.invite(Holder("hall"), 90, HOUR), signing.new_key()
    wishes = (
        x509.CertificateSigningRequestBuilder()
        .subject_name(x509.Name.from_rfc4514_string("CN=router"))
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("router.plant")]), critical=False)
        .sign(key, hashes.SHA256())
        .public_bytes(serialization.Encoding.PEM)
    )
    made = signing.certificate_of(authority.enrol("hall", code.secret, wishes))
    assert signing.name_of(made) == "hall"
    assert not made.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    names = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "router.plant" not in names.get_values_for_type(x509.DNSName)


def test_a_request_needs_its_private_key_and_a_good_kind_of_key(authority: Authority) -> None:
    code = authority.invite(Holder("hall"), 90, HOUR)
    other = rsa.generate_private_key(65537, 2048)
    named = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([]))
    pem = serialization.Encoding.PEM
    good = x509.load_pem_x509_csr(signing.request_for("hall", signing.new_key()))
    forged = bytearray(good.public_bytes(serialization.Encoding.DER))
    forged[-1] ^= 1
    for request in (
        named.sign(other, hashes.SHA256()).public_bytes(pem),
        ssl.DER_cert_to_PEM_cert(bytes(forged))
        .replace("CERTIFICATE", "CERTIFICATE REQUEST")
        .encode(),
        b"",
        b"\0" * 500,
    ):
        with pytest.raises(ConfigError, match="no request for a certificate with a P-256 key"):
            authority.enrol("hall", code.secret, request)
    assert not authority.state().invitations["hall"].used_by


def test_a_code_expires_and_a_clock_set_back_does_not_bring_it_back(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = authority.invite(Holder("hall"), 90, HOUR)
    request, now = signing.request_for("hall", signing.new_key()), [code_time := 2e9]
    monkeypatch.setattr("time.time", lambda: now[0])
    sweep(authority.folder)
    now[0] = code_time - 1e9
    with pytest.raises(NotAllowed, match="has expired"):
        authority.enrol("hall", code.secret, request)


def test_codes_of_other_names_and_other_secrets_are_refused(authority: Authority) -> None:
    code, request = authority.invite(Holder("hall"), 90, HOUR), b""
    other = authority.invite(Holder("press"), 90, HOUR)
    request = signing.request_for("hall", signing.new_key())
    for name, secret in (
        *(("hall", other.secret), ("nobody", code.secret), ("hall", ""), ("hall", "é" * 22)),
    ):
        with pytest.raises(NotAllowed, match="not known"):
            authority.enrol(name, secret, request)
    newer = authority.invite(Holder("hall"), 90, HOUR)
    with pytest.raises(NotAllowed, match="not known"):
        authority.enrol("hall", code.secret, request)
    assert authority.enrol("hall", newer.secret, request)


async def test_an_address_that_guesses_waits_and_a_large_body_is_refused(
    authority: Authority,
) -> None:
    code = authority.invite(Holder("hall"), 90, HOUR)
    request = signing.request_for("hall", signing.new_key()).decode()
    good = {"name": "hall", "secret": code.secret, "request": request}
    async with served(authority):
        status, _ = await asyncio.to_thread(post, authority, "/enrol", b"x" * 2**17)
        assert status == 413
        assert (await asyncio.to_thread(post, authority, "/enrol", {"name": "hall"}))[0] == 400
        assert (await asyncio.to_thread(post, authority, "/renew", b"[1"))[0] == 400
        for _ in range(3, MOST_TRIES):
            status, said = await asyncio.to_thread(
                post, authority, "/enrol", {**good, "secret": "guess"}
            )
            assert status == 403
            assert code.secret.encode() not in said
        for sent in ({**good, "secret": "guess"}, good):
            assert (await asyncio.to_thread(post, authority, "/enrol", sent))[0] == 429
    assert authority.enrol("hall", code.secret, request.encode())


async def test_nothing_is_sent_to_an_authority_that_is_not_that_of_the_code(
    authority: Authority, tmp_path: Path
) -> None:
    create(tmp_path / "false", 3650)
    false = Authority(tmp_path / "false")
    code = authority.invite(Holder("hall"), 90, HOUR)
    false.serve_at(code.at)
    async with served(false):
        with pytest.raises(GatewayError, match="another authority than that of the code"):
            await asyncio.to_thread(enrolment.enrol, tmp_path / "hall", code)
    assert [*(tmp_path / "hall").iterdir()] == []


async def test_the_name_of_the_authority_counts(authority: Authority, tmp_path: Path) -> None:
    code = authority.invite(Holder("hall"), 90, HOUR)
    elsewhere = code._replace(at=code.at.replace("127.0.0.1", "127.0.0.2"))
    authority.serve_at("10.9.9.9:1")
    async with served(authority, elsewhere.at):
        with pytest.raises(GatewayError, match="cannot be trusted"):
            await asyncio.to_thread(enrolment.enrol, tmp_path / "hall", elsewhere)
    assert not (tmp_path / "hall/hall.pem").exists()


async def test_a_full_disk_at_the_newcomer_costs_nothing_but_another_try(
    authority: Authority, tmp_path: Path
) -> None:
    code, place = authority.invite(Holder("hall"), 90, HOUR), tmp_path / "hall"
    place.mkdir()
    blocked = place / "hall.pem.new"  # the file that is written first
    blocked.mkdir()
    async with served(authority):
        with pytest.raises(GatewayError, match=r"hall\.pem cannot be written"):
            await asyncio.to_thread(enrolment.enrol, place, code)
        assert not (place / "hall.pem").exists()
        blocked.rmdir()
        found = await asyncio.to_thread(enrolment.enrol, place, code)
    assert expires(found.certificate.read_bytes())


def test_a_disk_that_takes_nothing_at_the_authority_uses_no_code_up(authority: Authority) -> None:
    code, request = (
        authority.invite(Holder("hall"), 90, HOUR),
        signing.request_for("hall", signing.new_key()),
    )
    blocked = authority.folder / "authority.json.new"
    blocked.mkdir()
    with pytest.raises(GatewayError, match="cannot be written"):
        authority.enrol("hall", code.secret, request)
    blocked.rmdir()
    assert not authority.state().invitations["hall"].used_by
    assert authority.enrol("hall", code.secret, request)


async def test_a_certificate_is_renewed_in_its_last_third_for_the_same_key(
    authority: Authority, tmp_path: Path
) -> None:
    place = tmp_path / "hall"
    code = authority.invite(Holder("hall"), DUE, HOUR)
    async with served(authority):
        found = await asyncio.to_thread(enrolment.enrol, place, code)
        before, key = found.certificate.read_bytes(), found.key.read_bytes()
        assert await asyncio.to_thread(enrolment.renew, place) == (found, True)
        renewed = found.certificate.read_bytes()
        assert renewed != before
        assert expires(renewed) >= expires(before)
        assert found.key.read_bytes() == key
        authority.revoke("hall")
        with pytest.raises(GatewayError, match="the certificate of hall is revoked"):
            await asyncio.to_thread(enrolment.renew, place)
        assert found.certificate.read_bytes() == renewed


def test_a_certificate_is_renewed_by_its_own_key_only(authority: Authority, tmp_path: Path) -> None:
    made, key = enrolled(authority, "hall", DUE)
    other, other_key = enrolled(authority, "press", DUE)
    create(tmp_path / "false", 3650)
    false, false_key = enrolled_elsewhere(tmp_path / "false")
    for certificate, signer in ((made, other_key), (false, false_key), (other, key)):
        with pytest.raises(NotAllowed, match="another authority, or of another key"):
            authority.renew(certificate, signing.request_for("hall", signer))
    # A request that was overheard brings a certificate that only the key can use.
    replayed = signing.request_for("press", key)
    assert signing.name_of(signing.certificate_of(authority.renew(made, replayed))) == "hall"


def enrolled_elsewhere(folder: Path) -> tuple[bytes, signing.PrivateKey]:
    false = Authority(folder)
    false.serve_at("127.0.0.1:1")
    return enrolled(false, "hall", DUE)


def test_a_name_that_enrolled_again_renews_with_its_new_key_only(authority: Authority) -> None:
    old, old_key = enrolled(authority, "hall", DUE)
    _, key = enrolled(authority, "hall", DUE)
    with pytest.raises(NotAllowed, match="enrolled again with another key"):
        authority.renew(old, signing.request_for("hall", old_key))
    authority.revoke("hall")
    made, key = enrolled(authority, "hall", DUE)
    assert authority.renew(made, signing.request_for("hall", key))
    with pytest.raises(NotAllowed, match="is revoked"):
        authority.renew(old, signing.request_for("hall", old_key))


def test_an_ended_certificate_is_not_renewed(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, key = enrolled(authority, "hall", DUE)
    later = expires(made) + 1
    monkeypatch.setattr("time.time", lambda: later)
    with pytest.raises(NotAllowed, match="has ended"):
        authority.renew(made, signing.request_for("hall", key))


def test_revoked_certificates_are_listed_and_openssl_refuses_them(authority: Authority) -> None:
    made, _ = enrolled(authority, "hall")
    enrolled(authority, "press")
    authority.revoke("hall")
    listed = x509.load_pem_x509_crl((authority.folder / "revoked.pem").read_bytes())
    own = signing.certificate_of(authority.certificate)
    assert listed.is_signature_valid(own.public_key())  # type: ignore[arg-type]
    assert [one.serial_number for one in listed] == [signing.certificate_of(made).serial_number]
    with pytest.raises(ConfigError, match="known: hall, press"):
        authority.revoke("mixer")


async def test_two_programs_do_not_serve_one_folder(authority: Authority) -> None:
    async with served(authority):
        with pytest.raises(ConfigError, match="another plc-gateway ca serve runs"):
            await serve(authority, "", "")
    create(authority.folder / "other", 10)
    with pytest.raises(ConfigError, match="write with --at"):
        await serve(Authority(authority.folder / "other"), "", "")


def test_a_command_that_stands_still_delays_the_others_for_seconds_only(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.cli.certificates.state.WAITS", 0.1)
    with (authority.folder / "lock").open("rb+") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(GatewayError, match="another command holds"):
            authority.invite(Holder("hall"), 90, HOUR)
    assert authority.invite(Holder("hall"), 90, HOUR)


def test_a_folder_that_others_can_read_or_that_is_damaged_is_refused(authority: Authority) -> None:
    code = authority.invite(Holder("hall"), 90, HOUR)
    key, state = authority.folder / "ca.key", authority.folder / "authority.json"
    key.chmod(0o644)
    with pytest.raises(ConfigError, match="open to every user of this machine"):
        Authority(authority.folder)
    key.chmod(0o600)
    whole = state.read_bytes()
    for damaged in (whole[:-20], b"[]", b""):
        state.write_bytes(damaged)
        with pytest.raises(ConfigError, match="restore it from a backup"):
            authority.enrol("hall", code.secret, signing.request_for("hall", signing.new_key()))
        assert state.read_bytes() == damaged
    key.write_bytes(signing.pem_of_key(signing.new_key()))
    with pytest.raises(ConfigError, match="is not the key of"):
        Authority(authority.folder)
    with pytest.raises(ConfigError, match="its certificates would end with it"):
        create(authority.folder, 10)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "hall@ca.plant:8444/short/00",
        "hall@ca.plant:8444/" + "s" * 22 + "/" + "0" * 63,
        "../x@ca.plant:8444/" + "s" * 22 + "/" + "0" * 64,
    ],
)
def test_half_a_code_is_named(text: str) -> None:
    with pytest.raises(ConfigError, match="no whole code") as error:
        Code.parsed(text)
    assert "s" * 22 not in str(error.value)


@pytest.mark.parametrize(
    ("name", "addresses", "says"),
    [
        ("ca", [], "is no name here"),
        ("../hall", [], "is no name here"),
        ("x" * 65, [], "is no name here"),
        ("hall", ["gate way"], "is no name of a machine"),
    ],
)
def test_names_and_addresses_are_checked(
    authority: Authority, name: str, addresses: list[str], says: str
) -> None:
    with pytest.raises(ConfigError, match=says):
        authority.invite(Holder(name, addresses), 90, HOUR)
    assert authority.state().names == {}
