//! One frame after the other: which rows came, what they add up to, whether anything moves.

use super::format::{Span, Visitor, visit};
use super::write::{Add, Pixels, Store, Write};
use super::{CameraError, CameraLayout, FrameStatus, LayoutError, MAX_BAND, MissingRows};
use crate::sensors::InputSize;
use crate::tensor::index;

/// Takes the rows of a camera and writes them into a network input.
///
/// The input is given to every call, because several cameras may write into one. Rows of an image that is scaled down
/// are added up to one row of the crop, so the (two, four or eight) rows of each come together, in any order.
#[derive(Debug)]
pub struct Camera<'a> {
    pub(super) layout: CameraLayout,
    /// First row and column of the image that the crop needs.
    pub(super) top: u32,
    pub(super) left: u32,
    /// Per plane and row of the crop: how many pixels, from the left, were written.
    progress: &'a mut [u16],
    /// Per column of the crop and component: sum over the pixels of the current band.
    sums: &'a mut [u16],
    bands: [Band; 2],
    hash: u32,
    previous: Option<u32>,
    repeats: u16,
}

/// Rows of a plane that become one row of the crop.
#[derive(Clone, Copy, Debug, Default)]
struct Band {
    /// Row of the crop.
    row: Option<u32>,
    /// Per row of the band: how many pixels, from the left, were added.
    received: [u32; MAX_BAND],
}

/// Part of a row of one plane: pixels `first..end` of the image's width.
#[derive(Clone, Copy)]
struct Piece<'a> {
    row: u32,
    is_chroma: bool,
    first: u32,
    end: u32,
    bytes: &'a [u8],
}

impl Piece<'_> {
    /// The pixels `start..end` of the image, which this piece is to continue; `None` if it brings nothing new.
    fn span(&self, start: u32, end: u32) -> Result<Option<(Span, u32)>, CameraError> {
        let end = self.end.min(end);
        if end <= start {
            return Ok(None);
        }
        let gap = CameraError::Gap { row: self.row, expected: start, found: self.first };
        let skip = index(start.checked_sub(self.first).ok_or(gap)?);
        let count = end.saturating_sub(start);
        Ok(Some((Span { skip, count: index(count) }, count)))
    }
}

impl<'a> Camera<'a> {
    /// A camera before its first frame; takes the first words of `memory`, whatever they hold.
    ///
    /// # Errors
    /// The layout is impossible, or there are fewer words than [`CameraLayout::memory_words`].
    pub fn new(layout: CameraLayout, memory: &'a mut [u16]) -> Result<Self, LayoutError> {
        layout.check()?;
        let saturated = |words: usize| u32::try_from(words).unwrap_or(u32::MAX);
        let error = LayoutError::Memory { found: saturated(memory.len()), needed: saturated(layout.memory_words()) };
        let (progress, rest) = memory.split_at_mut_checked(layout.progress_words()).ok_or(error)?;
        let sums = rest.get_mut(..layout.sum_words()).ok_or(error)?;
        let [left, top] =
            [(layout.width, layout.map.width), (layout.height, layout.map.height)].map(|(image, crop)| {
                let scaled = u32::from(image).wrapping_shr(layout.scale.bits());
                (scaled.saturating_sub(crop.into()) / 2).wrapping_shl(layout.scale.bits())
            });
        let bands = [Band::default(); 2];
        let mut camera = Self { layout, top, left, progress, sums, bands, hash: 0, previous: None, repeats: 0 };
        camera.clear();
        Ok(camera)
    }

    /// Abandons the frame under way. The network's input keeps what was written.
    pub fn clear(&mut self) {
        self.progress.fill(0);
        self.bands = [Band::default(); 2];
        self.hash = 0;
    }

    /// Takes a piece of a row: `bytes` from byte `offset` of the row on. Bytes beyond the row's pixels are padding and
    /// not read, and neither are pixels that the crop does not need or that came before. Pieces of one row come from
    /// left to right; between them may come any others.
    ///
    /// # Errors
    /// The input has a wrong size, there is no such row, the piece splits a pixel, or a piece before it is missing.
    pub fn push(&mut self, row: u32, offset: u32, bytes: &[u8], input: &mut [i8]) -> Result<(), CameraError> {
        InputSize::check(input.len(), self.layout.map.elements())?;
        let piece = self.piece(row, offset, bytes)?;
        let height = u32::from(self.layout.height);
        // The image's row where this one begins; a row of chroma covers two.
        let image_row = if piece.is_chroma { row.wrapping_sub(height).wrapping_mul(2) } else { row };
        if self.layout.scale.bits() > 0 {
            return self.add(image_row, piece, input);
        }
        self.copy(image_row, piece, input)?;
        if piece.is_chroma {
            self.copy(image_row.wrapping_add(1), piece, input)?;
        }
        Ok(())
    }

    /// Takes a whole image whose rows begin `stride` bytes apart; see [`Self::push`].
    ///
    /// # Errors
    /// The input has a wrong size, or the image ends before a row that is needed.
    pub fn push_image(&mut self, image: &[u8], stride: u32, input: &mut [i8]) -> Result<(), CameraError> {
        let height = u32::from(self.layout.height);
        let end = self.top.wrapping_add(u32::from(self.layout.map.height).wrapping_shl(self.layout.scale.bits()));
        let chroma_rows = match self.layout.is_planar() {
            true => height.wrapping_add(self.top / 2)..height.wrapping_add(end.wrapping_add(1) / 2),
            false => 0..0,
        };
        for row in (self.top..end).chain(chroma_rows) {
            let found = u32::try_from(image.len()).unwrap_or(u32::MAX);
            let bytes = u64::from(self.row_bytes(row >= height));
            let start = u64::from(row).wrapping_mul(stride.into());
            let range = usize::try_from(start).ok().zip(usize::try_from(start.wrapping_add(bytes)).ok());
            let bytes = range.and_then(|(start, end)| image.get(start..end));
            self.push(row, 0, bytes.ok_or(CameraError::ImageBytes { found, row })?, input)?;
        }
        Ok(())
    }

    /// Ends the frame and begins the next.
    ///
    /// # Errors
    /// Rows of the crop that are not whole. Such a frame is not compared with others.
    pub fn finish(&mut self) -> Result<FrameStatus, MissingRows> {
        let missing = self.missing();
        let hash = self.hash;
        self.clear();
        missing.map_or(Ok(()), Err)?;
        self.repeats = if self.previous == Some(hash) { self.repeats.saturating_add(1) } else { 0 };
        self.previous = Some(hash);
        let limit = self.layout.frozen_after;
        let is_frozen = limit > 0 && self.repeats >= limit;
        Ok(if is_frozen { FrameStatus::Frozen { repeats: self.repeats } } else { FrameStatus::Live })
    }

    fn missing(&self) -> Option<MissingRows> {
        let rows = self.layout.map.height;
        let is_missing = |row: &u16| {
            let planes = self.progress.iter().skip(usize::from(*row)).step_by(usize::from(rows).max(1));
            planes.into_iter().any(|&done| done < self.layout.map.width)
        };
        let first = (0..rows).find(is_missing)?;
        let count = u16::try_from((first..rows).filter(is_missing).count()).unwrap_or(u16::MAX);
        let image_row = self.top.wrapping_add(u32::from(first).wrapping_shl(self.layout.scale.bits()));
        Some(MissingRows { count, first: u16::try_from(image_row).unwrap_or(u16::MAX) })
    }

    /// Bytes of a row without padding.
    fn row_bytes(&self, is_chroma: bool) -> u32 {
        let unit = self.layout.format.unit(is_chroma);
        let units = u32::from(self.layout.width).checked_div(unit.pixels.into()).unwrap_or(0);
        units.wrapping_mul(unit.bytes.into())
    }

    fn piece<'b>(&self, row: u32, offset: u32, bytes: &'b [u8]) -> Result<Piece<'b>, CameraError> {
        let rows = self.layout.rows();
        if row >= rows {
            return Err(CameraError::NoSuchRow { row, rows });
        }
        let is_chroma = row >= u32::from(self.layout.height);
        let unit = self.layout.format.unit(is_chroma);
        let bytes = bytes.get(..index(self.row_bytes(is_chroma).saturating_sub(offset))).unwrap_or(bytes);
        // A row has at most 2^18 bytes.
        let length = u32::try_from(bytes.len()).unwrap_or(0);
        let split = CameraError::SplitPixel { row, unit: unit.bytes };
        let pixels = |bytes: u32| -> Result<u32, CameraError> {
            let is_whole = bytes.checked_rem(unit.bytes.into()) == Some(0);
            let units = bytes.checked_div(unit.bytes.into()).filter(|_| is_whole).ok_or(split)?;
            Ok(units.wrapping_mul(u32::from(unit.pixels)))
        };
        let first = pixels(offset)?;
        let end = first.saturating_add(pixels(length)?);
        Ok(Piece { row, is_chroma, first, end, bytes })
    }

    /// The row of the crop that holds this row of the image.
    pub(super) fn crop_row(&self, image_row: u32) -> Option<u32> {
        let row = image_row.checked_sub(self.top)?.wrapping_shr(self.layout.scale.bits());
        (row < u32::from(self.layout.map.height)).then_some(row)
    }

    fn done(&mut self, row: u32, is_chroma: bool) -> Option<&mut u16> {
        let plane = if is_chroma { usize::from(self.layout.map.height) } else { 0 };
        self.progress.get_mut(plane.saturating_add(index(row)))
    }

    /// Pixels of the crop from this one on, in the network's input.
    fn pixels<'b>(&self, row: u32, column: u32, input: &'b mut [i8]) -> Pixels<'b> {
        let channels = usize::from(self.layout.map.channels);
        let position = row.wrapping_mul(self.layout.map.width.into()).wrapping_add(column);
        let start = index(position).saturating_mul(channels);
        let codes = input.get_mut(start..).unwrap_or_default();
        Pixels { codes, channels, first_channel: self.layout.first_channel.into(), position }
    }

    /// Pixels that are taken as they are.
    fn copy(&mut self, image_row: u32, piece: Piece<'_>, input: &mut [i8]) -> Result<(), CameraError> {
        let Some(row) = self.crop_row(image_row) else { return Ok(()) };
        let done = self.done(row, piece.is_chroma).map_or(0, |done| u32::from(*done));
        let end = self.left.wrapping_add(self.layout.map.width.into());
        let Some((span, count)) = piece.span(self.left.wrapping_add(done), end)? else { return Ok(()) };
        let (format, is_planar) = (self.layout.format, self.layout.is_planar());
        let pixels = self.pixels(row, done, input);
        if is_planar {
            visit(format, piece.is_chroma, piece.bytes, span, Store { pixels, is_chroma: piece.is_chroma });
            self.combine(row, piece.is_chroma, done..done.wrapping_add(count), input);
        } else {
            visit(format, false, piece.bytes, span, Write { pixels, hash: &mut self.hash });
        }
        self.advance(row, piece.is_chroma, done.wrapping_add(count));
        Ok(())
    }

    /// Pixels that are added up with others.
    fn add(&mut self, image_row: u32, piece: Piece<'_>, input: &mut [i8]) -> Result<(), CameraError> {
        let Some(row) = self.crop_row(image_row) else { return Ok(()) };
        let (bits, width) = (self.layout.scale.bits(), self.layout.map.width);
        if self.done(row, piece.is_chroma).is_none_or(|done| *done == width) {
            return Ok(());
        }
        let plane = usize::from(piece.is_chroma);
        let Some(mut band) = self.bands.get(plane).copied() else { return Ok(()) };
        let is_new = band.row != Some(row);
        if is_new {
            band = Band { row: Some(row), ..Band::default() };
        }
        let rows = 1_u32.wrapping_shl(bits) >> plane;
        let in_band = image_row.wrapping_sub(self.top).wrapping_shr(u32::from(piece.is_chroma)) & rows.wrapping_sub(1);
        let columns = u32::from(width).wrapping_shl(bits);
        let Some(received) = band.received.get_mut(index(in_band)) else { return Ok(()) };
        let span = piece.span(self.left.wrapping_add(*received), self.left.wrapping_add(columns))?;
        let Some((span, count)) = span else { return Ok(()) };
        // Only now: a piece that is refused or brings nothing leaves the band under way as it is.
        if is_new {
            self.clear_sums(piece.is_chroma);
        }
        // Half as many rows of chroma: each counts twice.
        let weight = if piece.is_chroma { 2 } else { 1 };
        let add = Add { sums: self.sums, column: *received, bits, weight };
        visit(self.layout.format, piece.is_chroma, piece.bytes, span, add);
        *received = received.wrapping_add(count);
        let is_whole = band.received.iter().take(index(rows)).all(|&received| received == columns);
        if let Some(stored) = self.bands.get_mut(plane) {
            *stored = band;
        }
        if is_whole {
            self.write_means(row, piece.is_chroma, input);
        }
        Ok(())
    }

    /// Begins new sums of the components of a plane.
    fn clear_sums(&mut self, is_chroma: bool) {
        let is_planar = self.layout.is_planar();
        for [first, second, third] in self.sums.as_chunks_mut::<3>().0 {
            match (is_planar, is_chroma) {
                (false, _) => [*first, *second, *third] = [0; 3],
                (true, false) => *first = 0,
                (true, true) => [*second, *third] = [0; 2],
            }
        }
    }

    /// A whole row of the crop from its sums.
    fn write_means(&mut self, row: u32, is_chroma: bool, input: &mut [i8]) {
        let (format, is_planar, width) = (self.layout.format, self.layout.is_planar(), self.layout.map.width);
        let shift = self.layout.scale.bits().wrapping_mul(2);
        let half = 1_u16.wrapping_shl(shift) >> 1;
        let mut pixels = self.pixels(row, 0, input);
        let means = self.sums.as_chunks::<3>().0.iter().map(|sums| {
            // At most 64·255 + 32, shifted right by 6.
            sums.map(|sum| u8::try_from(sum.wrapping_add(half).wrapping_shr(shift)).unwrap_or(u8::MAX))
        });
        if is_planar {
            Store { pixels, is_chroma }.visit(means, |yuv| yuv);
            self.combine(row, is_chroma, 0..width.into(), input);
        } else {
            let colors = means.map(|components| format.color(components));
            self.hash = self.hash.wrapping_add(pixels.write(colors));
        }
        self.advance(row, is_chroma, width.into());
    }

    /// Makes colors of Y, U and V where the other plane has come already.
    fn combine(&mut self, row: u32, is_chroma: bool, columns: core::ops::Range<u32>, input: &mut [i8]) {
        let other = self.done(row, !is_chroma).map_or(0, |done| u32::from(*done));
        let count = other.min(columns.end).saturating_sub(columns.start);
        let format = self.layout.format;
        let added = self.pixels(row, columns.start, input).convert(index(count), |yuv| format.color(yuv));
        self.hash = self.hash.wrapping_add(added);
    }

    fn advance(&mut self, row: u32, is_chroma: bool, columns: u32) {
        if let Some(done) = self.done(row, is_chroma) {
            *done = u16::try_from(columns).unwrap_or(u16::MAX);
        }
    }
}
