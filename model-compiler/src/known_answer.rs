//! The known answer of an image: what every step must give for seeded inputs, computed by the f64 model.
//!
//! The input rule is the firmware's ([`firmware::image::known_answer`]); the answer is not: a target that reproduces it
//! agrees with the independent model, not just with the engine of some host.

use crate::emit::KnownAnswer;
use crate::error::Result;
use crate::integer_reference;
use crate::memory_plan::MemoryPlan;
use crate::qmodel::QModel;
use firmware::image::crc32;
use firmware::image::known_answer::Generator;
use firmware::tensor::ElementType;

/// Seed of every image: a start-up test needs inputs that move all codes, not new ones.
const SEED: u64 = 0x6b6e_6f77_6e21;

/// Runs the f64 model on the seeded inputs. `progress` is called after each step with the number done and the total.
///
/// # Errors
/// An intermediate exceeds the bounds of the arithmetic (a defect of the quantizer).
pub fn known_answer(model: &QModel, plan: &MemoryPlan, mut progress: impl FnMut(usize, usize)) -> Result<KnownAnswer> {
    let mut generator = Generator::new(SEED);
    let inputs: Vec<Vec<f64>> = model
        .inputs
        .iter()
        .map(|port| {
            let tensor = model.tensor(port.tensor);
            let mut bytes = vec![0; tensor.shape.elements() as usize * tensor.element.bytes() as usize];
            generator.fill(tensor.element, &mut bytes);
            codes(&bytes, tensor.element)
        })
        .collect();
    let mut crcs = vec![0; model.steps.len()];
    integer_reference::run(model, &inputs, |index, step, codes| {
        crcs[index] = crc32(&integer_reference::to_bytes(codes, model.tensor(step.op.output()).element));
        progress(index + 1, model.steps.len());
    })?;
    let step_crcs = plan.order.iter().map(|&index| crcs[index as usize]).collect();
    Ok(KnownAnswer { seed: SEED, step_crcs })
}

fn codes(bytes: &[u8], element: ElementType) -> Vec<f64> {
    match element {
        ElementType::I8 | ElementType::Scratch => bytes.iter().map(|&b| f64::from(b.cast_signed())).collect(),
        ElementType::I16 => bytes.as_chunks().0.iter().map(|&b| f64::from(i16::from_le_bytes(b))).collect(),
        ElementType::I32 => bytes.as_chunks().0.iter().map(|&b| f64::from(i32::from_le_bytes(b))).collect(),
    }
}
