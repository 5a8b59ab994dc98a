"""The engine: keys, plan, store, execution. It knows stages only through their record, `engine.stage.Stage`."""
