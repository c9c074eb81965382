//! A new model image in the field: two slots of a NOR flash, one that runs and one that the next image is written to.
//!
//! The image that runs is executed in place and never touched. The next one is received into the other slot, read back,
//! parsed and checked there, and only then named by a *slot record*, the last thing that an update writes. Whenever the
//! power fails, the next start finds the old image or the new one, whole.
//!
//! # The life of a device
//!
//! | event | slot A | slot B | the next start runs |
//! |---|---|---|---|
//! | factory | image, no record | empty | A |
//! | update | | image, record 1 | B, on trial |
//! | [`Updater::confirm`] after the self-test | | confirmed | B |
//! | update | image, record 2 | | A, on trial |
//! | no confirmation in [`TRIALS`] starts | given up | | B |
//! | update that fails or is cut off anywhere | no record | | B |
//!
//! A start takes the slot with the newest record whose image passes [`Image::parse`], [`Image::check`] and the board's
//! [`Requirements`]; else the other slot. An image without any record is the factory's, and stands last. If none is
//! left, [`select`] says why for both slots, and an [`Updater`] without a running image receives a new one into slot A.
//!
//! ```
//! use firmware::image::{CheckProgress, Image};
//! use firmware::kernels::{Kernels, Portable};
//! use firmware::update::{Manifest, MappedFlash, Requirements, Slots, UpdateError, Updater, select};
//!
//! const SLOT_BYTES: u32 = 1 << 20;
//!
//! /// Receives an image that a host sends in pieces, while the old one runs.
//! fn update<'a>(
//!     mut flash: impl MappedFlash,
//!     manifest: &Manifest,
//!     pieces: impl Iterator<Item = &'a [u8]>,
//!     feed_watchdog: &mut dyn FnMut(),
//! ) -> Result<(), UpdateError> {
//!     let slots = Slots::new(&flash, [0, SLOT_BYTES], SLOT_BYTES).expect("a constant of the board");
//!     let has_waypoints = |image: &Image| image.output(0).is_some_and(|output| output.name == "waypoints");
//!     let requirements = Requirements {
//!         target: "cortex-m4",
//!         kernels: Portable.supported(),
//!         arenas: &[160 << 10],
//!         interface: &has_waypoints,
//!     };
//!     // At the start: which image to run.
//!     let running = select(&mut flash, &slots, &requirements, feed_watchdog).ok();
//!     let mut updater = Updater::new(flash, slots, requirements, running);
//!     // After the engine's self-test passed:
//!     updater.confirm()?;
//!     // Whenever a host has something newer; between any two calls the vehicle may drive.
//!     updater.begin(manifest)?;
//!     for piece in pieces {
//!         updater.write(updater.received(), piece)?;
//!         feed_watchdog();
//!     }
//!     while updater.finish(4096)? != CheckProgress::Done {
//!         feed_watchdog();
//!     }
//!     Ok(()) // the next start tries the new image
//! }
//! ```
//!
//! # A slot
//!
//! A slot is a whole number of erase sectors. The image lies at its start, where it is executed; the last sector holds
//! the record, in units of 16 bytes or of the flash's write (or read) size where that is larger. Every unit is written
//! once after an erase, so flash with error-correcting codes will do, too.
//!
//! | unit | content | written |
//! |---|---|---|
//! | 0 | claim: [`CLAIM`] | after the sector was erased, before the image's sectors are |
//! | 1 | counter, bytes of the image, CRC of its header, CRC of these 12 bytes (`u32` each) | by [`Updater::finish`] |
//! | 2, 4, 6 | tried: [`TRIED`] | when a start takes the image on trial |
//! | 3, 5, 7 | confirmed: [`CONFIRMED`] | by [`Updater::confirm`] during that trial |
//!
//! Why this is enough: a slot with a claim runs only if its record is whole, so what a broken-off update left behind
//! never runs. While a record is erased, it may say anything; but then the image is one that nothing has touched yet,
//! or it has lost its header: an update that finds what must not run erases that first. A record is believed only with
//! its CRC, and its image only after every byte of it was checked. Counters are compared as serial numbers, so that
//! they may wrap. A trial counts when any bit of its mark is written, a confirmation only when all are: a mark torn by
//! a power cut costs one trial, and the next start has another. A unit that cannot be read (an error-correcting code
//! that a torn write left wrong) counts as written, but holds nothing.
//!
//! # What an update refuses
//!
//! See [`Refusal`]: an image that is too large, for another target than the board's or `portable`, with features,
//! kernels or memory that the board does not have, with another interface than the application needs, with a lower
//! revision than the running one's, or
//! damaged. The same revision is accepted if the image differs (a rebuild); the very image that runs is refused, as
//! there is nothing to do. Most of it is known from the [`Manifest`], before a sector is erased.
//!
//! A CRC is no signature: whoever can reach the link can send an image. Where that matters, check a signature over the
//! image between the link and [`Updater::write`], and let it come before the last piece.
#![deny(
    clippy::indexing_slicing,
    clippy::arithmetic_side_effects,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic
)]

#[cfg(doc)]
use crate::image::Image;

mod error;
mod flash;
mod record;
mod requirements;
mod select;
mod slots;
mod updater;

pub use error::{FlashError, FlashOperation, UpdateError};
pub use flash::MappedFlash;
pub use record::{CLAIM, CONFIRMED, TRIALS, TRIED};
pub use requirements::{Manifest, Refusal, Requirements, TargetName, same_interface};
pub use select::{SelectError, Selected, Unusable, select};
pub use slots::{Slot, Slots, SlotsError};
pub use updater::Updater;
