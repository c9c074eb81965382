//! A reader that stops reading is no error: `host-sim … | head -1`.

use std::process::{Command, Stdio};

#[test]
fn a_closed_pipe_is_no_error() {
    for arguments in [["--help", "--version"], ["completions", "bash"]] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let program = env!("CARGO_BIN_EXE_host-sim");
        let child = Command::new(program).args(arguments).stdout(writer).stderr(Stdio::piped()).spawn().unwrap();
        let output = child.wait_with_output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!((output.status.code(), said.as_ref()), (Some(0), ""), "{arguments:?}");
    }
}
