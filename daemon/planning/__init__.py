"""Flight plans: lines and the specification of a project, and reflights."""
