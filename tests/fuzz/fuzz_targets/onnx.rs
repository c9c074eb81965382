//! No bytes make the ONNX importer or the passes panic, or take memory beyond a multiple of their number.
#![no_main]

use libfuzzer_sys::fuzz_target;
use model_compiler::import::{ImportOptions, onnx};
use model_compiler::ir::verify::verify;
use model_compiler::passes;

fuzz_target!(|bytes: &[u8]| {
    onnx::is_onnx(bytes);
    let Ok(model) = onnx::Model::parse(bytes.to_vec()) else { return };
    let options = ImportOptions { resolution: Some((8, 8)), ..Default::default() };
    for options in [ImportOptions::default(), options] {
        let Ok(mut graph) = onnx::import(&model, None, &options) else { continue };
        if passes::optimize(&mut graph).is_ok() {
            assert_eq!(verify(&graph), Ok(()));
        }
    }
});
