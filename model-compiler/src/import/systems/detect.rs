//! Sizes of a network from its tensors' names and shapes.
//!
//! Every function tolerates single wrong tensors (sizes are the most common ones), so that a damaged checkpoint still
//! gives sensible expectations to list its problems against.

use crate::import::NamedTensors;
use std::collections::BTreeMap;

/// Largest size that is believed; shapes hold at most this.
const MAX_SIZE: usize = u16::MAX as usize;

/// One more than the largest index `i` (below 256) of the names `{prefix}{i}.…`.
pub(super) fn indexed_count(tensors: &NamedTensors, prefix: &str) -> usize {
    tensors
        .under(prefix)
        .filter_map(|(name, _)| name[prefix.len()..].split_once('.')?.0.parse::<u8>().ok())
        .max()
        .map_or(0, |largest| usize::from(largest) + 1)
}

/// The most common leading dimension of the tensors under any of these prefixes that satisfy `select`.
pub(super) fn common_length(tensors: &NamedTensors, prefixes: &[&str], select: impl Fn(&str) -> bool) -> Option<usize> {
    let lengths = prefixes
        .iter()
        .flat_map(|prefix| tensors.under(prefix))
        .filter(|(name, _)| select(name))
        .filter_map(|(_, tensor)| tensor.shape.first().copied());
    most_common(lengths)
}

/// The most common of these sizes; the larger one on a tie.
pub(super) fn most_common(sizes: impl Iterator<Item = usize>) -> Option<usize> {
    let mut counts = BTreeMap::new();
    for size in sizes.filter(|size| (1..=MAX_SIZE).contains(size)) {
        *counts.entry(size).or_insert(0u32) += 1;
    }
    counts.into_iter().max_by_key(|&(_, count)| count).map(|(size, _)| size)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_wrong_tensor_does_not_change_the_sizes() {
        let tensor = |name: &str, shape: &[usize]| (name.to_string(), shape.to_vec(), vec![]);
        let tensors = NamedTensors::new(
            [
                tensor("layer1.0.conv1.weight", &[9, 4, 3, 3]),
                tensor("layer1.0.bn1.bias", &[8]),
                tensor("layer1.0.bn1.weight", &[8]),
                tensor("layer1.3.bn1.weight", &[1 << 40]),
                tensor("layer1.99999.bn1.weight", &[1 << 40]),
                tensor("layer1.x.bn1.weight", &[0]),
            ],
            [],
        );
        assert_eq!(common_length(&tensors, &["layer1."], |_| true), Some(8));
        assert_eq!(indexed_count(&tensors, "layer1."), 4);
        assert_eq!(indexed_count(&tensors, "layer2."), 0);
        assert_eq!(common_length(&tensors, &["layer2."], |_| true), None);
    }
}
