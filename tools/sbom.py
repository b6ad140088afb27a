"""Writes packaging/sbom.cdx.json, the bill of materials that each wheel contains (PEP 770)."""

import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FILE = ROOT / "packaging/sbom.cdx.json"
OWN = "zenoh-plc-gateway"
_ASSETS = ROOT / "gateway/parts/web/assets"


def main() -> None:
    """Describes the environment that the command line names."""
    tool = Path(sys.executable).with_name("cyclonedx-py")
    command: list[str | Path] = [tool, "environment", "--output-reproducible", sys.argv[1]]
    found = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    text = json.dumps(of_wheel(found), indent=1, ensure_ascii=False) + "\n"
    schema = import_module("cyclonedx.schema").SchemaVersion.V1_6
    validator = import_module("cyclonedx.validation.json").JsonStrictValidator(schema)
    if fault := validator.validate_str(text):
        raise SystemExit(f"{FILE} would not be CycloneDX 1.6: {fault}")
    FILE.write_text(text, "utf-8")


def of_wheel(found: dict[str, Any]) -> dict[str, Any]:
    """Returns the gateway as the main component. The addresses of the packages are left out."""
    [own] = [one for one in found["components"] if one["name"] == OWN]
    packages = [
        {name: value for name, value in one.items() if name != "externalReferences"}
        for one in found["components"]
        if one is not own
    ]
    graph = {one["ref"]: one.get("dependsOn", []) for one in found["dependencies"]}
    plot = _uplot()
    graph[own["bom-ref"]] = sorted([*graph[own["bom-ref"]], plot["bom-ref"]])
    graph[plot["bom-ref"]] = []
    return {
        **{name: found[name] for name in ("$schema", "bomFormat", "specVersion", "version")},
        "metadata": {
            "component": {
                "bom-ref": own["bom-ref"],
                "type": "application",
                "name": OWN,
                "version": own["version"],
                "description": own["description"],
                "licenses": own["licenses"][:1],
                "purl": f"pkg:pypi/{OWN}@{own['version']}",
            },
            "properties": found["metadata"]["properties"],
        },
        "components": [*packages, plot],
        "dependencies": [
            {"ref": ref, "dependsOn": graph[ref]}
            for ref in sorted(graph)
            if ref != "root-component"
        ],
    }


def _uplot() -> dict[str, Any]:
    """Returns the library of the page, which is no Python package."""
    [version] = re.findall(r"uPlot \(v([\d.]+)\)", (_ASSETS / "uplot.js").read_text("utf-8"))
    return {
        "bom-ref": f"uplot=={version}",
        "type": "library",
        "name": "uplot",
        "version": version,
        "licenses": [{"license": {"acknowledgement": "declared", "id": "MIT"}}],
        "purl": f"pkg:npm/uplot@{version}",
    }


if __name__ == "__main__":
    main()
