"""Certificates for tests, made with openssl."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

from tests.support.machine_needs import require

CA_CONFIG = """
[ca]
default_ca = own
[own]
database = index.txt
new_certs_dir = .
serial = serial
default_md = sha256
policy = any
unique_subject = no
copy_extensions = copy
[any]
commonName = supplied
organizationalUnitName = optional
"""


def openssl(folder: Path, *arguments: str) -> None:
    require("openssl")
    subprocess.run(
        ["openssl", *arguments], cwd=folder, check=True, capture_output=True, timeout=120
    )


@dataclass(frozen=True)
class Authority:
    """Makes certificates in its folder; NAME.pem and NAME.key."""

    folder: Path

    @classmethod
    def new(cls, folder: Path) -> Authority:
        folder.mkdir()
        (folder / "ca.cnf").write_text(CA_CONFIG)
        (folder / "index.txt").write_text("")
        (folder / "serial").write_text("01\n")
        key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
        openssl(
            folder,
            "req",
            "-x509",
            *key,
            "-keyout",
            "ca.key",
            "-out",
            "ca.pem",
            "-subj",
            "/CN=lab",
            "-days",
            "2",
        )
        return cls(folder)

    def certificate(
        self, name: str, role: str = "", dates: tuple[str, ...] = ("-days", "1")
    ) -> tuple[Path, Path]:
        subject = (f"/OU={role}" if role else "") + f"/CN={name}"
        key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
        names = ("-addext", "subjectAltName=IP:127.0.0.1")
        openssl(
            self.folder,
            "req",
            *key,
            "-keyout",
            f"{name}.key",
            "-out",
            f"{name}.csr",
            "-subj",
            subject,
            *names,
        )
        ca = ("-config", "ca.cnf", "-cert", "ca.pem", "-keyfile", "ca.key", "-batch", "-notext")
        openssl(self.folder, "ca", *ca, "-in", f"{name}.csr", "-out", f"{name}.pem", *dates)
        return self.folder / f"{name}.pem", self.folder / f"{name}.key"

    @property
    def own(self) -> Path:
        return self.folder / "ca.pem"


def tls_fleet(file: Path, holds: dict[str, tuple[str, str, str]]) -> Path:
    """A fleet file of holds: address, files of the client's certificate without suffix, and the
    authority's file.
    """
    file.write_text(
        "".join(
            f'[[holds]]\nname = "{name}"\ntls = "{tls}"\ncertificate_file = '
            f'"{pair}.pem"\nkey_file = "{pair}.key"\n'
            f'authority_file = "{authority}"\n'
            for name, (tls, pair, authority) in holds.items()
        )
    )
    return file
