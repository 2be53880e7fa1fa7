"""What the collector and the learner agree on: vocabulary, configuration, the store, the networks."""
