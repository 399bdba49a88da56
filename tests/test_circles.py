"""No file imports another that imports it, directly or by way of more, inside a function or out of it."""

from graphlib import TopologicalSorter

import grimp


def test_no_file_imports_itself_by_way_of_others() -> None:
    graph = grimp.build_graph("gradscape", exclude_type_checking_imports=True, cache_dir=None)
    imports = {one: graph.find_modules_directly_imported_by(one) for one in graph.modules}
    assert {"gradscape.envs.engines.mpm.solver", "gradscape.optim.race", "gradscape.cli"} <= set(imports)
    assert "gradscape.envs.records" in imports["gradscape.envs.base"]
    TopologicalSorter(imports).prepare()  # raises CycleError, which names the modules of one circle
