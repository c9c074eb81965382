//! What `model_compiler::pipeline` will provide; replaced by it at integration.

use model_compiler::error::{Error, ErrorCode, Result};
use model_compiler::ir::Graph;
use std::path::{Path, PathBuf};

/// The optimized float graph of a checkpoint.
///
/// # Errors
/// Always, until the importer is there.
pub fn load_graph(path: &Path) -> Result<Graph> {
    Err(Error::new(ErrorCode::Unsupported, path.display().to_string(), "this build has no importer"))
}

/// The record that belongs to an image: the same name with the extension `record`.
pub fn record_path(image_path: &Path) -> PathBuf {
    image_path.with_extension("record")
}
