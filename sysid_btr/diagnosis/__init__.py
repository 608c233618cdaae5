"""What the model lacks: `close` fits what is declared, and takes one `State` through three stages to a verdict.

`search` adds effects: `scan` asks what each would do to the residual (`torque` and `signature` say when and where to
ask for events), `hypotheses` are what the answers call for, `trials` refits them and chooses. `elimination` drops what
data do not miss; `uncertainty` gives the rest intervals. `verdict` names them; `split` moves the held-out part, and all
starts again, where it alone shows what is missing. Every threshold, and what it decides, is in `selection`.
"""
