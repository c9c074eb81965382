//! No bytes make the checkpoint readers panic, or take memory beyond a small multiple of their number.
#![no_main]

use libfuzzer_sys::fuzz_target;
use model_compiler::import::checkpoint::parse;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(checkpoint) = parse(bytes) {
        assert!(!checkpoint.tensors().is_empty());
        for tensor in checkpoint.tensors() {
            assert_eq!(tensor.data.len(), tensor.shape.iter().product::<usize>());
            assert!(checkpoint.get(&tensor.name).is_some());
            tensor.first_non_finite();
        }
    }
});
