//! `Image::parse`: every check, in file order.

use super::{Image, ParseError};

pub(super) fn parse(_bytes: &[u8]) -> Result<Image<'_>, ParseError> {
    todo!()
}
