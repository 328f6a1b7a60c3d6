from rosrm import Commit, Stop
from rosrm.testing import MigrationContract
from rosrm_example import ExampleOptions, ExampleStrategy, register_migration_strategies


class TestExample(MigrationContract):
    offer = register_migration_strategies()[0]

    def test_the_source_is_stopped_first(self):
        plan = ExampleStrategy(ExampleOptions()).propose(self.moves()[0])
        assert isinstance(plan.steps[0], Stop)
        assert isinstance(plan.steps[-1], Commit)
