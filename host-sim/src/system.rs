//! Which of the published systems a network is, and what is known of it outside the network.

use crate::points::PixelGrid;
use firmware::drive::profile::Answer;
use firmware::drive::{Profile, System};
use firmware::image::Image;
use model_compiler::error::{Error, ErrorCode, Result};

/// The system of a network with inputs of these names; `None` where they are no driving network's.
pub fn of_inputs(names: &[&str]) -> Option<System> {
    System::of_inputs(|name| names.contains(&name))
}

/// Names of an image's inputs.
pub fn input_names<'a>(image: &Image<'a>) -> Vec<&'a str> {
    (0..image.input_count()).filter_map(|i| Some(image.input(i)?.name)).collect()
}

/// The system of an image.
///
/// # Errors
/// Its inputs are those of no driving network.
pub fn of_image(image: &Image<'_>) -> Result<System> {
    let names = input_names(image);
    of_inputs(&names).ok_or_else(|| {
        let message = format!("it reads {}, which is no driving network's set of inputs", names.join(", "));
        let error = Error::new(ErrorCode::Unsupported, format!("network {}", image.name()), message);
        error.with_help("host-sim run shows what other networks give")
    })
}

/// The system as published. A network that points into smaller maps than the published one sees the middle of the
/// camera's image.
pub fn profile(system: System, maps: Option<PixelGrid>) -> Profile {
    let mut profile = system.profile();
    if let (Answer::ImagePoints(camera), Some(maps)) = (&mut profile.answer, maps) {
        camera.size = maps.size();
    }
    profile
}

#[cfg(test)]
mod tests {
    use super::*;
    use firmware::drive::projection::GroundCamera;
    use firmware::tensor::Shape;

    #[test]
    fn six_sets_of_inputs_are_six_systems() {
        let systems: [(&[&str], System); 6] = [
            (&["rgb", "bev", "velocity", "goal"], System::TransFuser),
            (&["rgb", "goal"], System::Aim),
            (&["goal", "bev", "rgb"], System::LateFusion),
            (&["rgb", "bev", "bev_points", "cam_points", "goal"], System::GeometricFusion),
            (&["rgb", "velocity", "command"], System::Cilrs),
            (&["views"], System::Lbc),
        ];
        for (names, system) in systems {
            assert_eq!(of_inputs(names), Some(system));
        }
        for names in [&[][..], &["rgb"], &["data"], &["rgb", "bev"], &["rgb", "velocity"]] {
            assert_eq!(of_inputs(names), None, "{names:?}");
        }
    }

    #[test]
    fn smaller_maps_are_the_middle_of_the_same_camera() {
        let maps = PixelGrid::of_shape(Shape::map(48, 64, 4));
        let expected = GroundCamera { size: [64, 48], ..GroundCamera::LBC };
        assert_eq!(profile(System::Lbc, Some(maps)).answer, Answer::ImagePoints(expected));
        assert_eq!(profile(System::Lbc, None), System::Lbc.profile());
        assert_eq!(profile(System::Aim, Some(maps)), System::Aim.profile());
    }
}
