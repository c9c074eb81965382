//! Operators that change the extents and keep the elements in their order: `Flatten`, `Reshape`, `Squeeze`,
//! `Unsqueeze`, and a `Transpose` that moves only extents of 1 (or a constant).

use crate::error::Result;
use crate::import::onnx::activation::Value;
use crate::import::onnx::node::Node;
use crate::import::onnx::tensor::elements;
use crate::import::onnx::translate::Translator;

/// Longest list of extents; ONNX's own limit for shapes is lower in practice.
const MAX_RANK: usize = 16;

pub(super) fn flatten(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.value(node, 0)?;
    let rank = x.dims().len();
    let axis = node.int("axis", 1)?;
    let axis = if axis == rank as i64 { rank } else { node.axis(axis, rank)? };
    let (before, behind) = x.dims().split_at(axis);
    let (Some(rows), Some(columns)) = (elements(before), elements(behind)) else {
        return Err(node.malformed(format!("flattens {}", x.described())));
    };
    reshaped(node, x, vec![rows, columns])
}

/// 0 keeps an extent (unless `allowzero`), −1 takes what is left.
pub(super) fn reshape(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.value(node, 0)?;
    let wanted = t.integers(node, 1)?.ok_or_else(|| node.malformed("found no shape"))?;
    let allow_zero = node.int("allowzero", 0)? != 0;
    let wrong = || node.malformed(format!("found shape {wanted:?} for {}", x.described()));
    if wanted.len() > MAX_RANK {
        return Err(node.unsupported(format!("found rank {}, expected at most {MAX_RANK}", wanted.len())));
    }
    let mut dims = Vec::with_capacity(wanted.len());
    let mut inferred = None;
    for (i, &size) in wanted.iter().enumerate() {
        dims.push(match size {
            0 if !allow_zero => *x.dims().get(i).ok_or_else(wrong)?,
            -1 if inferred.is_none() => {
                inferred = Some(i);
                1
            }
            size => usize::try_from(size).map_err(|_| wrong())?,
        });
    }
    if let Some(i) = inferred {
        let known = elements(&dims).filter(|&known| known > 0).ok_or_else(wrong)?;
        dims[i] = elements(x.dims()).ok_or_else(wrong)? / known;
    }
    reshaped(node, x, dims)
}

pub(super) fn squeeze(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.value(node, 0)?;
    let rank = x.dims().len();
    let axes = match axes(t, node)? {
        None => (0..rank).filter(|&axis| x.dims()[axis] == 1).collect(),
        Some(axes) => axes.iter().map(|&axis| node.axis(axis, rank)).collect::<Result<Vec<usize>>>()?,
    };
    if let Some(axis) = axes.iter().find(|&&axis| x.dims()[axis] != 1) {
        return Err(node.malformed(format!("squeezes axis {axis} of {}, expected an extent of 1", x.described())));
    }
    let dims = (0..rank).filter(|axis| !axes.contains(axis)).map(|axis| x.dims()[axis]).collect();
    reshaped(node, x, dims)
}

pub(super) fn unsqueeze(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.value(node, 0)?;
    let axes = axes(t, node)?.ok_or_else(|| node.malformed("found no axes"))?;
    let rank = x.dims().len() + axes.len();
    if rank > MAX_RANK {
        return Err(node.unsupported(format!("found rank {rank}, expected at most {MAX_RANK}")));
    }
    let axes = axes.iter().map(|&axis| node.axis(axis, rank)).collect::<Result<Vec<usize>>>()?;
    let mut kept = x.dims().iter();
    let dims: Vec<usize> =
        (0..rank).filter_map(|axis| if axes.contains(&axis) { Some(1) } else { kept.next().copied() }).collect();
    if dims.len() != rank {
        return Err(node.malformed(format!("found axes {axes:?}, expected different ones")));
    }
    reshaped(node, x, dims)
}

/// An attribute to operator set 12, then an operand.
fn axes(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Option<Vec<i64>>> {
    if node.opset < 13 { Ok(node.ints("axes")?.map(<[i64]>::to_vec)) } else { t.integers(node, 1) }
}

pub(super) fn transpose(t: &mut Translator<'_>, node: &Node<'_>) -> Result<Value> {
    let x = t.value(node, 0)?;
    let rank = x.dims().len();
    let permutation: Vec<usize> = match node.ints("perm")? {
        None => (0..rank).rev().collect(),
        Some(perm) => perm.iter().map(|&axis| node.axis(axis, rank)).collect::<Result<_>>()?,
    };
    if (0..rank).any(|axis| !permutation.contains(&axis)) || permutation.len() != rank {
        return Err(node.malformed(format!("found perm {permutation:?} for {}", x.described())));
    }
    let long: Vec<usize> = permutation.iter().copied().filter(|&axis| x.dims()[axis] != 1).collect();
    match x {
        Value::Constant(tensor) => {
            t.charge(tensor.len())?;
            Ok(Value::Constant(tensor.transpose(&permutation)))
        }
        Value::Activation(_) if long.is_sorted() => {
            let dims = permutation.iter().map(|&axis| x.dims()[axis]).collect();
            reshaped(node, x, dims)
        }
        Value::Activation(x) => {
            let found = x.described();
            Err(node
                .unsupported(format!("permutes {found} by {permutation:?}, expected only extents of 1 to move"))
                .with_help("export the network in the order N×C×H×W throughout"))
        }
    }
}

fn reshaped(node: &Node<'_>, x: Value, dims: Vec<usize>) -> Result<Value> {
    x.reshaped(dims, node.place()).map_err(|message| node.malformed(message))
}
