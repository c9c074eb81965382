//! A tensor as torch stores it: a strided view of a flat storage, which several tensors may share.

use std::borrow::Cow;
use std::collections::BTreeMap;

use crate::error::{Error, ErrorCode, Result};

use super::element::{DType, decode};
use super::{NamedTensor, malformed, output_budget, quoted};

/// More axes than any operator uses; bounds the work per tensor.
pub(super) const MAX_RANK: usize = 32;

/// The storage a tensor names; the bytes live elsewhere in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct StorageRef<'a> {
    /// Name of the storage in the file.
    pub key: &'a str,
    /// Type of its elements.
    pub dtype: DType,
    /// Elements the pickle claims; to be compared with the bytes that are there.
    pub elements: usize,
}

impl StorageRef<'_> {
    /// Claimed size; `None` where no file can hold it.
    pub fn bytes(&self) -> Option<usize> {
        self.elements.checked_mul(self.dtype.bytes()).filter(|&bytes| isize::try_from(bytes).is_ok())
    }
}

/// A strided view of a storage.
#[derive(Clone, Debug)]
pub(super) struct TensorView<'a> {
    pub storage: StorageRef<'a>,
    /// First element.
    pub offset: usize,
    /// Extents, outermost first.
    pub shape: Vec<usize>,
    /// Elements between neighbors along each axis.
    pub strides: Vec<usize>,
}

impl<'a> TensorView<'a> {
    /// A view whose elements all lie in `window`, a range of the storage's elements. The error says found and expected.
    pub fn new(
        storage: StorageRef<'a>,
        window: std::ops::Range<usize>,
        offset: usize,
        shape: Vec<usize>,
        strides: Vec<usize>,
    ) -> std::result::Result<Self, String> {
        if shape.len() != strides.len() {
            return Err(format!("found {} extents and {} strides, expected as many", shape.len(), strides.len()));
        }
        element_count(&shape).ok_or_else(|| format!("found the shape {shape:?}, whose element count overflows"))?;
        let view = Self { storage, offset: window.start.saturating_add(offset), shape, strides };
        match view.end() {
            Some(end) if end <= window.end => Ok(view),
            end => Err(format!(
                "found a view (offset {offset}, shape {:?}, strides {:?}) that ends at element {}, expected at most {}",
                view.shape,
                view.strides,
                end.map_or("2^64".to_owned(), |end| end.saturating_sub(window.start).to_string()),
                window.len()
            )),
        }
    }

    /// One past the last element, in the storage; `None` on overflow. A view without elements ends nowhere.
    fn end(&self) -> Option<usize> {
        if self.shape.contains(&0) {
            return Some(0);
        }
        let mut axes = self.shape.iter().zip(&self.strides);
        axes.try_fold(self.offset, |last, (extent, stride)| last.checked_add((extent - 1).checked_mul(*stride)?))?
            .checked_add(1)
    }

    /// Number of elements.
    pub fn elements(&self) -> usize {
        self.shape.iter().product()
    }

    /// The view's elements from the storage's bytes, row-major.
    fn pack<'s>(&self, storage: &'s [u8]) -> Cow<'s, [u8]> {
        let width = self.storage.dtype.bytes();
        if self.shape.contains(&0) {
            return Cow::Borrowed(&[]);
        }
        if self.is_contiguous() {
            return Cow::Borrowed(&storage[self.offset * width..(self.offset + self.elements()) * width]);
        }
        let mut packed = Vec::with_capacity(self.elements() * width);
        let mut index = vec![0; self.shape.len()];
        let mut element = self.offset;
        for _ in 0..self.elements() {
            packed.extend_from_slice(&storage[element * width..(element + 1) * width]);
            // The next index, innermost axis first, as an odometer counts.
            for axis in (0..index.len()).rev() {
                index[axis] += 1;
                if index[axis] < self.shape[axis] {
                    element += self.strides[axis];
                    break;
                }
                element -= self.strides[axis] * (self.shape[axis] - 1);
                index[axis] = 0;
            }
        }
        Cow::Owned(packed)
    }

    fn is_contiguous(&self) -> bool {
        let mut expected = 1;
        self.shape.iter().zip(&self.strides).rev().all(|(&extent, &stride)| {
            let matches = extent == 1 || stride == expected;
            expected *= extent;
            matches
        })
    }
}

/// Number of elements of a shape whose extents, zeros left out, multiply to less than `isize::MAX` bytes of any type.
pub(super) fn element_count(shape: &[usize]) -> Option<usize> {
    let product =
        shape.iter().filter(|&&extent| extent != 0).try_fold(1usize, |all, &extent| all.checked_mul(extent))?;
    product.checked_mul(8).filter(|&bytes| isize::try_from(bytes).is_ok())?;
    Some(if shape.contains(&0) { 0 } else { product })
}

/// Converts every view, loading each storage once: only one storage is held beside the file and the results.
/// `load` returns exactly the storage's claimed bytes.
pub(super) fn gather<'s>(
    views: &[(&str, &TensorView)],
    file_bytes: usize,
    mut load: impl FnMut(&StorageRef) -> Result<Cow<'s, [u8]>>,
) -> Result<Vec<NamedTensor>> {
    check_budget(views, file_bytes)?;
    let mut by_key: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for (at, (_, view)) in views.iter().enumerate() {
        by_key.entry(view.storage.key).or_default().push(at);
    }
    let mut tensors: Vec<Option<NamedTensor>> = vec![None; views.len()];
    for users in by_key.values() {
        let (first_name, first) = views[users[0]];
        let bytes = load(&first.storage).map_err(|error| error.within(format!("tensor {}", quoted(first_name))))?;
        for &at in users {
            let (name, view) = views[at];
            if view.storage != first.storage {
                return Err(disagreement(name, view, first_name, first));
            }
            let data = decode(view.storage.dtype, &view.pack(&bytes));
            let (shape, dtype) = (view.shape.clone(), view.storage.dtype);
            tensors[at] = Some(NamedTensor { name: name.to_owned(), shape, dtype, data });
        }
    }
    Ok(tensors.into_iter().flatten().collect())
}

fn disagreement(name: &str, view: &TensorView, first_name: &str, first: &TensorView) -> Error {
    let message = format!(
        "found storage {} as {} × {}, expected {} × {} as in tensor {}",
        quoted(view.storage.key),
        view.storage.elements,
        view.storage.dtype.name(),
        first.storage.elements,
        first.storage.dtype.name(),
        quoted(first_name)
    );
    malformed(format!("tensor {}", quoted(name)), message)
}

fn check_budget(views: &[(&str, &TensorView)], file_bytes: usize) -> Result<()> {
    let budget = output_budget(file_bytes);
    let mut total = 0usize;
    for (name, view) in views {
        total = total.saturating_add(view.elements().saturating_mul(view.storage.dtype.converted_bytes()));
        if total > budget {
            let message = format!(
                "found shape {:?}, which brings the tensors to {total} bytes in a file of {file_bytes}, expected at most {budget}",
                view.shape
            );
            return Err(Error::new(ErrorCode::Malformed, format!("tensor {}", quoted(name)), message)
                .with_help("save contiguous tensors: {name: tensor.contiguous()}"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::TensorData;
    use super::*;

    const STORAGE: StorageRef = StorageRef { key: "0", dtype: DType::U8, elements: 24 };

    fn values(view: &TensorView) -> Vec<i64> {
        let bytes: Vec<u8> = (0..24).collect();
        match decode(DType::U8, &view.pack(&bytes)) {
            TensorData::Integer(values) => values,
            TensorData::Float(_) => panic!("u8 is not floating"),
        }
    }

    fn view(offset: usize, shape: &[usize], strides: &[usize]) -> std::result::Result<TensorView<'static>, String> {
        TensorView::new(STORAGE, 0..24, offset, shape.to_vec(), strides.to_vec())
    }

    #[test]
    fn strides_are_followed() {
        assert_eq!(values(&view(0, &[2, 3], &[3, 1]).unwrap()), [0, 1, 2, 3, 4, 5]);
        assert_eq!(values(&view(4, &[3, 2], &[1, 3]).unwrap()), [4, 7, 5, 8, 6, 9]);
        assert_eq!(values(&view(23, &[2, 2], &[0, 0]).unwrap()), [23; 4]);
        assert_eq!(values(&view(0, &[2, 1, 3], &[12, 99, 5]).unwrap()), [0, 5, 10, 12, 17, 22]);
        assert_eq!(values(&view(7, &[], &[]).unwrap()), [7]);
        assert_eq!(values(&view(0, &[3, 0], &[1, 1]).unwrap()), [0i64; 0]);
    }

    #[test]
    fn views_stay_inside_their_window() {
        assert!(view(0, &[24], &[1]).is_ok());
        assert!(view(1, &[24], &[1]).unwrap_err().contains("ends at element 25, expected at most 24"));
        assert!(view(0, &[2, 2], &[usize::MAX, 1]).is_err());
        assert!(view(usize::MAX, &[2], &[1]).is_err());
        assert!(view(0, &[1 << 40, 1 << 40, 0], &[1, 1, 1]).is_err());
        assert!(view(0, &[2], &[1, 1]).is_err());
        let window = TensorView::new(STORAGE, 4..8, 0, vec![4], vec![1]).unwrap();
        assert_eq!(values(&window), [4, 5, 6, 7]);
        assert!(TensorView::new(STORAGE, 4..8, 1, vec![4], vec![1]).is_err());
    }
}
