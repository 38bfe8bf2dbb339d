from export.graphs._old import (  # noqa: F401
    GRAPH_NAMES,
    GraphSpec,
    export_graph,
    graph_contract,
    graph_parameters,
    graph_specs,
    past_names,
)
