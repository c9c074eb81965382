//! A new model image for a board, over its line: announced, sent, checked there, started on trial, and confirmed by its
//! known answer ([`firmware::update`]).

use super::feeder::Feeder;
use super::{BITS_PER_BYTE, Connection, DEFAULT_BAUD, Place};
use crate::files::ImageFile;
use firmware::image::Image;
use firmware::link::{Identity, MAX_PIECE, PROTOCOL, Request, Response};
use firmware::update::Manifest;
use indicatif::ProgressBar;
use model_compiler::artifact;
use model_compiler::error::{Error, ErrorCode, Result};
use schemars::JsonSchema;
use serde::Serialize;
use std::path::PathBuf;
use std::time::Duration;

/// What to send, and where to.
#[derive(Clone, Debug)]
pub struct Options {
    /// The new image.
    pub image: PathBuf,
    /// Where the board is.
    pub place: Place,
    /// The image that an emulated board runs before.
    pub running: Option<PathBuf>,
    /// How long nothing may go either way.
    pub timeout: Duration,
}

/// An update that was carried out.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct UpdateReport {
    /// Version of this structure.
    pub schema: u32,
    /// Name of the board.
    pub board: String,
    /// What it ran before; absent where there was nothing to run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub before: Option<InstalledImage>,
    /// What it runs now, confirmed.
    pub after: InstalledImage,
    /// Bytes that were sent.
    pub bytes_sent: u64,
    /// What these take on the line, s; of an emulated board at 115,200 baud.
    pub line_s: f64,
}

/// An image as a board names it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, JsonSchema)]
pub struct InstalledImage {
    /// Name of the model.
    pub model: String,
    /// Revision of the model.
    pub revision: u32,
    /// Target that it was compiled for.
    pub target: String,
    /// SHA-256 of the quantized model, 64 hexadecimal digits.
    pub qmodel_sha256: String,
    /// Length of the image.
    pub bytes: u32,
}

impl From<&Identity<'_>> for InstalledImage {
    fn from(identity: &Identity<'_>) -> Self {
        Self {
            model: identity.model.to_owned(),
            revision: identity.revision,
            target: identity.target.to_string(),
            qmodel_sha256: artifact::hex(&identity.qmodel_digest),
            bytes: identity.image_bytes,
        }
    }
}

/// Updates a board.
///
/// # Errors
/// Bad files, no board, one that refuses the image or is silent, or one that does not start the new image.
pub fn update(options: &Options, progress: &ProgressBar) -> Result<UpdateReport> {
    let file = ImageFile::read(&options.image)?;
    let image = file.parse()?;
    let (running, baud) = match (&options.place, &options.running) {
        (Place::Port { baud, .. }, _) => (&options.image, *baud),
        (Place::Emulated { .. }, Some(running)) => (running, DEFAULT_BAUD),
        (Place::Emulated { .. }, None) => {
            let message = "an emulated board has no image of its own";
            return Err(Error::new(ErrorCode::Usage, "--board", message)
                .with_help("give the image that it runs before: --running OLD.img"));
        }
    };
    let mut connection = Connection::open(&options.place, running)?;
    let outcome = converse(options, &image, baud, &mut connection, progress);
    match &mut connection.emulator {
        Some(emulator) => outcome.map_err(|error| emulator.explain(error)),
        None => outcome,
    }
}

fn converse(
    options: &Options,
    image: &Image<'_>,
    baud: u32,
    connection: &mut Connection,
    progress: &ProgressBar,
) -> Result<UpdateReport> {
    let mut feeder = Feeder::new(&connection.line, options.timeout);
    progress.set_message("start");
    let before = feeder.meet()?;
    let before = before.as_ref().and_then(|packet| match packet.response() {
        Response::Identity(identity) => Some(InstalledImage::from(&identity)),
        _ => None,
    });
    progress.set_message("send");
    progress.set_length(image.bytes().len() as u64);
    feeder.ask(&Request::Announce(Manifest::of(image)), "the announced image")?;
    let mut offset = 0;
    for bytes in image.bytes().chunks(MAX_PIECE) {
        feeder.ask(&Request::Piece { offset, bytes }, format!("the piece of the image at byte {offset}"))?;
        offset += bytes.len() as u32;
        progress.set_position(offset.into());
    }
    progress.set_message("install");
    feeder.ask(&Request::Install, "the image")?;
    feeder.ask(&Request::Restart, "Restart")?;
    let bytes_sent = feeder.take_bytes_sent();
    let packet = feeder.identify()?;
    let Response::Identity(identity) = packet.response() else { return Err(feeder.faulty("no identity came")) };
    if identity.protocol != PROTOCOL || identity.header_crc != image.header_crc() {
        let message = format!("after the restart it runs {}, revision {}", identity.model, identity.revision);
        return Err(Error::new(ErrorCode::Check, identity.board, message)
            .with_help("the new image did not start; the board went back to the one before"));
    }
    // On trial until then.
    feeder.ask(&Request::SelfTest, "SelfTest of the new image")?;
    let (board, after) = (identity.board.to_owned(), InstalledImage::from(&identity));
    if let Some(emulator) = &mut connection.emulator {
        feeder.ask(&Request::Halt, "Halt")?;
        emulator.finish(options.timeout)?;
    }
    let line_s = (bytes_sent * BITS_PER_BYTE) as f64 / f64::from(baud);
    Ok(UpdateReport { schema: 1, board, before, after, bytes_sent, line_s })
}
