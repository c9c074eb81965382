//! Which driving network an image is, and what its output says.

use crate::drive::profile::{Answer as AnswerKind, Profile, System};
use crate::drive::{NetworkError, NetworkOutput};
use crate::engine::Engine;
use crate::image::Image;
use crate::kernels::Kernels;
use crate::link::Answer;
use crate::program::Step;
use crate::tensor::{ElementType, TensorId};
use crate::waypoint;
use heapless::Vec;

/// Name of the output that holds controls; waypoints and points are the first output.
const CONTROLS: &str = "controls";

/// A driving network.
#[derive(Clone, Copy, Debug)]
pub(super) struct Network {
    pub profile: Profile,
    output: u8,
    element: ElementType,
}

impl Network {
    /// The network of an image; `None` where it is no driving one.
    pub fn of_image(image: &Image<'_>) -> Option<Self> {
        let ports = || (0..image.input_count()).filter_map(|input| image.input(input));
        let system = System::of_inputs(|name| ports().any(|port| port.name == name))?;
        let has_controls = |&output: &u8| image.output(output).is_some_and(|port| port.name == CONTROLS);
        let output = (0..image.output_count()).find(has_controls).unwrap_or(0);
        let tensor = image.output(output)?.tensor;
        let mut profile = system.profile();
        if let AnswerKind::ImagePoints(camera) = &mut profile.answer {
            // A network that points into smaller maps than the published one sees the middle of the camera's image.
            camera.size = maps(image, tensor).unwrap_or(camera.size);
        }
        Some(Self { profile, output, element: image.tensor(tensor)?.element })
    }

    /// What the network answered.
    pub fn answer<K: Kernels>(&self, engine: &Engine<'_, K>) -> Answer {
        let read = || {
            let bytes = engine.output(self.output.into()).ok()?;
            match (self.profile.answer, self.element) {
                (AnswerKind::Waypoints, ElementType::I32) => waypoint::read(bytes).map(Answer::Waypoints),
                (AnswerKind::ImagePoints(_), ElementType::I32) => {
                    let words = bytes.as_chunks::<4>().0.as_chunks::<2>().0;
                    let points = words.iter().map(|point| point.map(i32::from_le_bytes));
                    let mut all = Vec::new();
                    points.into_iter().try_for_each(|point| all.push(point)).ok()?;
                    Some(Answer::ImagePoints(all))
                }
                (AnswerKind::Controls, ElementType::I16) => {
                    let values = bytes.as_chunks::<2>().0.first_chunk::<3>()?;
                    Some(Answer::Controls(values.map(i16::from_le_bytes)))
                }
                _ => None,
            }
        };
        read().unwrap_or_default()
    }
}

/// Columns and rows of the maps whose pixels a tensor names.
fn maps(image: &Image<'_>, points: TensorId) -> Option<[u16; 2]> {
    let logits = (0..image.step_count()).find_map(|position| match image.step(position)? {
        Step::SpatialSoftmax(step) if step.output == points => Some(step.input),
        _ => None,
    });
    let shape = image.tensor(logits?)?.shape;
    Some([shape.width, shape.height])
}

/// As the driver takes it.
pub(super) fn network_output(answer: &Answer) -> Result<NetworkOutput<'_>, NetworkError> {
    match answer {
        Answer::Waypoints(waypoints) => Ok(NetworkOutput::Waypoints(waypoints)),
        Answer::ImagePoints(points) => Ok(NetworkOutput::ImagePoints(points)),
        Answer::Controls(codes) => Ok(NetworkOutput::Controls(*codes)),
        Answer::None => Err(NetworkError::Failed),
    }
}
