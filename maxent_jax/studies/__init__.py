"""The paper's figures and further studies: cells, raw values, statistics, figures."""
