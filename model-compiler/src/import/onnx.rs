//! ONNX files: convolutional classifiers of operator sets 7 to 20, read to the float graph.
//!
//! An ONNX file is one protobuf message that holds the network and its weights. [`Model::parse`] opens it; [`import`]
//! translates node by node, one file per family of operators. What only moves shapes around (the arithmetic that
//! exporters write before a `Reshape`) is computed here; batch is 1; maps change from `N×C×H×W` to
//! `height × width × channels`, weights with them. Values keep ONNX's node names, outputs their own.
//!
//! What is not supported is refused by name, all problems of a file in one message. The promises of the checkpoint
//! readers hold here too: no panic for any bytes, and no memory or time beyond a multiple of the file's length.

use super::ImportOptions;
use crate::error::{Error, ErrorCode, Result};
use crate::ir::Graph;
use external::Folder;
use std::path::Path;
use translate::Translator;

mod activation;
mod external;
mod input;
mod model;
mod node;
mod operators;
mod problems;
mod proto;
mod tensor;
mod translate;
mod window;

pub use model::Model;

/// Whether a file is one of ONNX, told from its first bytes: the fields of a message by their numbers, the format
/// version first. A truncated file is recognized too.
pub fn is_onnx(bytes: &[u8]) -> bool {
    // Keys of `ModelProto`: number · 8 + wire type. A safetensors header could begin like this, but goes on with the
    // zeros of its length.
    const KEYS: [u8; 10] = [0x12, 0x1a, 0x22, 0x28, 0x32, 0x3a, 0x42, 0x72, 0xa2, 0xca];
    let is_safetensors = bytes.get(5..9) == Some(b"\0\0\0{");
    match bytes {
        [0x08, 1..=127] => true,
        [0x08, 1..=127, key, ..] => KEYS.contains(key) && !is_safetensors,
        _ => false,
    }
}

/// Builds the float graph of an ONNX model; its data files, if any, lie in `folder`.
///
/// The input is the image in raw units (grey levels 0..=255), normalized by [`ImportOptions::normalization`]; the
/// system is `classifier`.
///
/// # Errors
/// `Unsupported` for what is not translated, `Malformed` for what contradicts ONNX, `Tensors` for weights that are not
/// finite, `Usage` for options that do not fit.
pub fn import(model: &Model, folder: Option<&Path>, options: &ImportOptions) -> Result<Graph> {
    for (option, is_given) in [
        ("--system", options.system.is_some()),
        ("--heads", options.heads.is_some()),
        ("--fusion-scales", options.fusion_scales.is_some()),
        ("--hack", options.hack),
        ("--temperature", options.temperature.is_some()),
    ] {
        if is_given {
            return Err(Error::new(ErrorCode::Usage, "", format!("{option} has no effect on an ONNX file"))
                .with_help(format!("leave {option} out")));
        }
    }
    let mut translator = Translator::new(model, folder.map_or_else(Folder::none, Folder::new));
    input::add(&mut translator, &model.inputs, options)?;
    translator.nodes();
    translator.name_outputs();
    translator.problems.into_result()?;
    Ok(translator.graph)
}

#[cfg(test)]
mod tests {
    use super::is_onnx;

    #[test]
    fn files_are_told_from_their_first_fields() {
        for bytes in [&b"\x08\x07"[..], b"\x08\x08\x12\x07pytorch", b"\x08\x04:\x00", b"\x08\x0a\xa2\x01"] {
            assert!(is_onnx(bytes), "{}", bytes.escape_ascii());
        }
        let safetensors = b"\x08\x01\x12\0\0\0\0\0{\"a\"";
        for bytes in [&b""[..], b"\x08", b"\x08\x00\x12", b"\x08\x07\x00", b"PK\x03\x04", b"\x80\x02", safetensors] {
            assert!(!is_onnx(bytes), "{}", bytes.escape_ascii());
        }
    }
}
