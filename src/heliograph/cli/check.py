"""`heliograph check`: a network as a diagram, and what is doubtful in it before any data."""

DOUBTFUL = 1


def check(network: str, /) -> int:
    """Show your own network as a diagram, and what is doubtful in it before any data.

    Judged are states that no sensor shows, errors that grow without end, memory of links that a filter ignores, what
    links share, and what native code does not take, such as a filter of your own, with the line. The exit status is 0
    where nothing is doubtful, 1 where something is, and 2 for bad input.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network: my_network.py, or my_network.py:name where it
        holds several. The name may be that of a function that returns one.
    """
    from heliograph.disk.quoting import visible
    from heliograph.files.network_file import load_network
    from heliograph.simulation.description.doubts import doubts_before_data

    # The diagram, then a line for each doubt.
    loaded = load_network(network)
    print("\n".join(map(visible, loaded.diagram().splitlines())))
    lines = doubts_before_data(loaded)
    print()
    for line in lines:
        print(visible(f"{'doubtful' if line.serious else 'note'}: {line.words}"))
    serious = sum(line.serious for line in lines)
    print(f"{serious} doubtful" if serious else "nothing doubtful")
    return DOUBTFUL if serious else 0
