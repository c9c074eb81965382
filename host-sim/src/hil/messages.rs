//! What a board's program logs by `defmt`: numbers on the way, text by the symbols of the program.

use defmt_decoder::{DecodeError, Table};
use model_compiler::error::{Error, ErrorCode, Result};
use std::path::Path;

/// Lines of a stream, each with its level. What is cut off or damaged ends it.
///
/// # Errors
/// The program cannot be read, or was built without `defmt`.
pub fn decode(program: &Path, stream: &[u8]) -> Result<Vec<String>> {
    let elf = std::fs::read(program).map_err(|e| Error::io(program, &e))?;
    let refuse = |message: String| {
        Error::new(ErrorCode::Unsupported, program.display().to_string(), message)
            .with_help("build the board's program with --features defmt")
    };
    let table = Table::parse(&elf).map_err(|e| refuse(format!("its messages cannot be read: {e}")))?;
    let table = table.ok_or_else(|| refuse("the program holds no defmt messages".into()))?;
    let mut decoder = table.new_stream_decoder();
    decoder.received(stream);
    let mut lines = Vec::new();
    loop {
        match decoder.decode() {
            Ok(frame) => {
                let level = frame.level().map_or("", |level| level.as_str());
                lines.push(format!("{level:<5} {}", frame.display_message()));
            }
            Err(DecodeError::Malformed) if table.encoding().can_recover() => {}
            Err(DecodeError::UnexpectedEof | DecodeError::Malformed) => return Ok(lines),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_without_messages_says_how_to_build_one_with_them() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), b"no program at all").unwrap();
        let error = decode(file.path(), &[]).unwrap_err();
        assert_eq!(error.code.exit_status(), 2);
        assert!(error.help.contains("--features defmt"), "{error}");
    }
}
