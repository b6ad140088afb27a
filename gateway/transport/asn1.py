"""Reads elements of ASN.1 in DER: of certificates, and of lists of revoked ones.

The standard library checks them, and shows no more than some of their fields.
"""

import ssl

INTEGER, SEQUENCE, _EXTENSIONS = 0x02, 0x30, 0xA0
_BEGIN, _END = "-----BEGIN X509 CRL-----", "-----END X509 CRL-----"


def element(data: bytes) -> tuple[int, bytes]:
    """Returns tag and content of the first element. Raises `IndexError` without one."""
    start, size = _place(data)
    return data[0], data[start : start + size]


def after(data: bytes) -> bytes:
    """Returns what follows the first element. Raises `IndexError` without one."""
    start, size = _place(data)
    return data[start + size :]


def _place(data: bytes) -> tuple[int, int]:
    """Returns start and size of the content of the first element."""
    if data[1] < 0x80:
        return 2, data[1]
    start = 2 + (data[1] & 0x7F)
    return start, int.from_bytes(data[2:start], "big")


def revoked_numbers(pem: str) -> set[int]:
    """Returns the serial numbers in lists of revoked certificates (PEM), none from other content.

    RFC 5280, 5.1: version, algorithm, issuer, one or two times, then the certificates.
    """
    found = set[int]()
    for block in pem.split(_BEGIN)[1:]:
        try:
            text = f"{ssl.PEM_HEADER}\n{block.partition(_END)[0].strip()}\n{ssl.PEM_FOOTER}"
            _, listed = element(ssl.PEM_cert_to_DER_cert(text))
            _, fields = element(listed)
            fields = after(fields) if fields[0] == INTEGER else fields
            fields = after(after(fields))
            while fields and fields[0] not in (SEQUENCE, _EXTENSIONS):  # the times
                fields = after(fields)
            _, rest = element(fields) if fields and fields[0] == SEQUENCE else (0, b"")
            while rest:
                _, entry = element(rest)
                found.add(int.from_bytes(element(entry)[1], "big", signed=True))
                rest = after(rest)
        except (IndexError, ValueError):
            continue
    return found
