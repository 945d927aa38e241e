"""An import-linter contract: no import cycle between modules, imports under TYPE_CHECKING included."""

from __future__ import annotations

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output


class NoCycles(Contract):
    """No module of the packages imports itself through others.

    Configuration options:
        packages: the packages that are looked at.
    """

    type_name = "no_cycles"
    packages = fields.ListField(subfield=fields.StringField())

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Look for a way back along every import."""
        inside = tuple(f"{package}." for package in self.packages)  # type: ignore[attr-defined]
        found = []
        for module in sorted(graph.modules):
            if not module.startswith(inside):
                continue
            for imported in sorted(graph.find_modules_directly_imported_by(module)):
                if imported.startswith(inside) and graph.chain_exists(importer=imported, imported=module):
                    found.append((module, *(graph.find_shortest_chain(importer=imported, imported=module) or ())))
        return ContractCheck(kept=not found, metadata={"cycles": found})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """One line a cycle, each module importing the next."""
        for cycle in check.metadata["cycles"]:
            output.print_error(" -> ".join(cycle), bold=False)
