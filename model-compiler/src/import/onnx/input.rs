//! The network's image input.

use super::activation::{Activation, Value};
use super::proto::{self, element};
use super::translate::Translator;
use crate::error::{Error, ErrorCode, Result};
use crate::import::ImportOptions;
use crate::ir::{InputKind, Normalization, Op, Shape};
use std::sync::Arc;

/// ImageNet statistics for values 0..=255.
const IMAGE_MEAN: [f32; 3] = [123.675, 116.28, 103.53];
const IMAGE_STD: [f32; 3] = [58.395, 57.12, 57.375];

/// Adds the one image input and its normalization.
pub(super) fn add(t: &mut Translator<'_>, inputs: &[proto::ValueInfo], options: &ImportOptions) -> Result<()> {
    let [input] = inputs else {
        let names: Vec<_> = inputs.iter().map(|i| i.name.as_str()).collect();
        let found = if names.is_empty() { "none".into() } else { names.join(", ") };
        let message = format!("found {} inputs ({found}), expected one image", inputs.len());
        return Err(Error::new(ErrorCode::Unsupported, "", message)
            .with_help("export a network that reads one image and nothing else"));
    };
    let place = |e: Error| e.within(format!("input {}", input.name));
    let shape = shape(input, options.resolution).map_err(place)?;
    let normalization = normalization(options.normalization.as_ref(), shape).map_err(place)?;
    let name = t.unique(&input.name);
    let raw = t.graph.push_input(&name, InputKind::Image, shape);
    let normalized = t.unique(&format!("{name}.normalize"));
    let id = t.graph.push(normalized, Op::Normalize(Arc::new(normalization)), &[raw]);
    let id = id.map_err(|message| Error::new(ErrorCode::Usage, &name, message))?;
    t.define(&input.name, Value::Activation(Activation::map(id, shape)));
    Ok(())
}

/// Height, width and channels of `N×C×H×W`.
fn shape(input: &proto::ValueInfo, resolution: Option<(u16, u16)>) -> Result<Shape> {
    let refuse = |message: String, help: &str| Err(Error::new(ErrorCode::Unsupported, "", message).with_help(help));
    let tensor = input.r#type.as_ref().and_then(|t| t.tensor_type.as_ref());
    let (elem_type, dims) =
        tensor.map_or((0, &[][..]), |t| (t.elem_type, t.shape.as_ref().map_or(&[][..], |s| &s.dim)));
    if !matches!(elem_type, element::FLOAT | element::DOUBLE | element::FLOAT16 | element::BFLOAT16) {
        let message = format!("found elements of type {}, expected float", element::name(elem_type));
        return refuse(message, "export the network with a floating input; images are normalized on the device");
    }
    let [batch, channels, height, width] = dims else {
        let message = format!("found {} dimensions, expected an image N×C×H×W", dims.len());
        return refuse(message, "export the network with the shape of its input");
    };
    let fixed = |d: &proto::Dimension| d.dim_value.filter(|&value| value > 0);
    if let Some(found @ 2..) = fixed(batch) {
        return refuse(
            format!("found a batch of {found}, expected 1"),
            "export the network with a batch of 1 or a dynamic batch",
        );
    }
    let channels = match fixed(channels) {
        Some(count @ (1 | 3)) => count as u16,
        found => {
            let found = found.map_or("a dynamic number of".to_owned(), |count| count.to_string());
            let help = "images are RGB or grey; export N×C×H×W, channels before rows";
            return refuse(format!("found {found} channels, expected 3 or 1"), help);
        }
    };
    let given = resolution.map(|(h, w)| [h, w].map(i64::from));
    let mut size = [0; 2];
    for (axis, dimension) in [height, width].into_iter().enumerate() {
        let found = match (fixed(dimension), given) {
            (None, None) => {
                return refuse("found a dynamic height or width".into(), "say it with --resolution HxW");
            }
            (Some(found), Some(given)) if found != given[axis] => {
                let message = format!("found a fixed size of {found} pixels, but --resolution says {}", given[axis]);
                return refuse(message, "leave --resolution out, or export the network with a dynamic size");
            }
            (Some(found), _) => found,
            (None, Some(given)) => given[axis],
        };
        let Ok(pixels) = u16::try_from(found) else {
            return refuse(format!("found {found} pixels, expected at most 65535"), "");
        };
        size[axis] = pixels;
    }
    Ok(Shape::map(size[0], size[1], channels))
}

/// The given normalization, one value standing for all channels; else ImageNet's for color, and 0..1 for grey.
fn normalization(given: Option<&Normalization>, shape: Shape) -> Result<Normalization> {
    let channels = usize::from(shape.channels);
    let Some(given) = given else {
        return Ok(match channels {
            3 => Normalization { mean: IMAGE_MEAN.to_vec(), std: IMAGE_STD.to_vec() },
            _ => Normalization { mean: vec![0.0; channels], std: vec![255.0; channels] },
        });
    };
    let spread = |option: &str, values: &[f32]| match values {
        [one] => Ok(vec![*one; channels]),
        values if values.len() == channels => Ok(values.to_vec()),
        values => {
            let message = format!("found {} values for {channels} channels", values.len());
            Err(Error::new(ErrorCode::Usage, option, message).with_help("give one value per channel, or one for all"))
        }
    };
    Ok(Normalization { mean: spread("--mean", &given.mean)?, std: spread("--std", &given.std)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_value_stands_for_all_channels_and_absent_ones_for_the_usual() {
        let (rgb, grey) = (Shape::map(8, 8, 3), Shape::map(8, 8, 1));
        let statistics = |mean: &[f32], std: &[f32]| Normalization { mean: mean.to_vec(), std: std.to_vec() };
        assert_eq!(normalization(None, rgb).unwrap(), statistics(&IMAGE_MEAN, &IMAGE_STD));
        assert_eq!(normalization(None, grey).unwrap(), statistics(&[0.0], &[255.0]));
        let given = statistics(&[127.5], &[1.0, 2.0, 3.0]);
        assert_eq!(normalization(Some(&given), rgb).unwrap(), statistics(&[127.5; 3], &[1.0, 2.0, 3.0]));
        assert_eq!(normalization(Some(&given), grey).unwrap_err().message, "found 3 values for 1 channels");
    }
}
