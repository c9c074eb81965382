//! The operators that are translated; one file per family.
//!
//! A translation takes its operands from the [`Translator`], adds nodes to the graph and returns what the first output
//! stands for. What it cannot express exactly it refuses.

use super::activation::Value;
use super::node::Node;
use super::translate::Translator;
use crate::error::Result;

mod activations;
mod arithmetic;
mod batch_norm;
mod concat;
mod constants;
mod conv;
mod linear;
mod pad;
mod pool;
mod reduce;
mod reshape;
mod slice;
mod softmax;

pub(super) type Operator = fn(&mut Translator<'_>, &Node<'_>) -> Result<Value>;

/// By name.
const OPERATORS: [(&str, Operator); 31] = [
    ("Add", arithmetic::add),
    ("AveragePool", pool::average_pool),
    ("BatchNormalization", batch_norm::batch_norm),
    ("Cast", constants::cast),
    ("Clip", activations::clip),
    ("Concat", concat::concat),
    ("Constant", constants::constant),
    ("ConstantOfShape", constants::constant_of_shape),
    ("Conv", conv::conv),
    ("Div", arithmetic::div),
    ("Dropout", activations::dropout),
    ("Flatten", reshape::flatten),
    ("Gather", constants::gather),
    ("Gemm", linear::gemm),
    ("GlobalAveragePool", pool::global_average_pool),
    ("GlobalMaxPool", pool::global_max_pool),
    ("Identity", activations::identity),
    ("MatMul", linear::mat_mul),
    ("MaxPool", pool::max_pool),
    ("Mul", arithmetic::mul),
    ("Pad", pad::pad),
    ("ReduceMean", reduce::reduce_mean),
    ("Relu", activations::relu),
    ("Reshape", reshape::reshape),
    ("Shape", constants::shape),
    ("Slice", slice::slice),
    ("Softmax", softmax::softmax),
    ("Squeeze", reshape::squeeze),
    ("Sub", arithmetic::sub),
    ("Transpose", reshape::transpose),
    ("Unsqueeze", reshape::unsqueeze),
];

pub(super) fn find(name: &str) -> Option<Operator> {
    OPERATORS.iter().find(|(known, _)| *known == name).map(|(_, operator)| *operator)
}

/// All names, for messages.
pub(super) fn names() -> String {
    OPERATORS.map(|(name, _)| name).join(", ")
}
