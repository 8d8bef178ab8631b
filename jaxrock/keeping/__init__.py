"""What is kept on disk between sessions: machine code, and programs that are lowered already.

Imports nothing of the package but what lies at its bottom.
Start reading at `folder`; `facts` tells when a question is the same as one that was asked before.
"""
