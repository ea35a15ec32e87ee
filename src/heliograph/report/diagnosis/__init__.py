"""What a recording contradicts: tests of the filters' claims by their innovations, reliability of links, doubts."""
