//! Writes `model-compiler/checkpoints/transfuser-small.safetensors` and `host-sim/frames/`: same bytes on every run.

fn main() -> Result<(), Box<dyn std::error::Error>> {
    tests::bundle::write()
}
