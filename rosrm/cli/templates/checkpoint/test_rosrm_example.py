from rosrm.testing import CheckpointContract
from rosrm_example import ExampleOptions, ExamplePolicy, register_checkpoint_policies


class TestExample(CheckpointContract):
    offer = register_checkpoint_policies()[0]
    options = {"every": "2s"}

    def test_the_replica_is_on_another_host(self):
        choice = ExamplePolicy(ExampleOptions()).choose(self.views()[0])
        assert choice.hosts == ("h1",)
