"""How good a model or a method is: scores over held-out scenes, and the statistics that go with them."""
