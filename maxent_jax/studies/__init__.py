"""The paper's figures and the studies beside them: cells, raw values, statistics, pictures."""
