"""The figures and the table of the paper's section IV, measured on the real system.

    python -m benchmarks.paper fig6|fig7|fig8|fig9|fig10|table3|fig11|all --out DIR

A master and slaves, started as users start them, run on virtual hosts (`rosrm_lab`: needs root).
Each figure leaves FIGURE.json and FIGURE.png in DIR.
"""
