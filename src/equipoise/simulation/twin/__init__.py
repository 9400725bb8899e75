"""The digital twin: MuJoCo, servo model, encoder and hand."""
