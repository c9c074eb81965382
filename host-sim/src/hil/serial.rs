//! A line over a serial device.

use super::line::Line;
use model_compiler::error::{Error, ErrorCode, Result};
use std::time::Duration;

/// How long the system waits for a byte before it looks whether the line is to be closed.
const LOOK: Duration = Duration::from_millis(100);

/// Opens a serial device: eight bits, no parity, one stop bit, no flow control.
///
/// # Errors
/// There is no such device, somebody else has it, or it knows no such rate.
pub fn open(device: &str, baud: u32) -> Result<Line> {
    let refuse = |error: serialport::Error| {
        Error::new(ErrorCode::Link, device, format!("no serial device at {baud} baud: {error}"))
            .with_help("check the name, the cable, and who may use the device (its group is often dialout)")
    };
    let writer = serialport::new(device, baud).timeout(LOOK).open().map_err(refuse)?;
    let reader = writer.try_clone().map_err(refuse)?;
    Ok(Line::new(device, reader, writer))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_that_is_not_there_is_named() {
        let error = open("/dev/no-such-device", 115_200).unwrap_err();
        assert_eq!((error.location.as_str(), error.code.exit_status()), ("/dev/no-such-device", 2));
        assert!(error.help.contains("dialout"));
    }
}
