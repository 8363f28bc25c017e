// SPDX-License-Identifier: Apache-2.0
// Hardware of ros2_control that is a simulator of sst_ros in lockstep.
//
// The simulator publishes /clock and a sample of joint_states with the same time, and waits for the
// command with that stamp. The controller manager, by use_sim_time, wakes at each /clock. `read`
// then waits for the sample of that time, however late it comes, and `write` answers it: an update
// of the controllers always sees the state of its own time, and each sample has one update. `read`
// takes the samples itself: the threads of the controller manager's executor, which would call back,
// may all wait for an update.
//
// Parameters in the ros2_control tag: joint_commands_topic, joint_states_topic, and timeout, the
// longest wait for a sample [s].

#include <chrono>
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "hardware_interface/system_interface.hpp"
#include "hardware_interface/types/hardware_interface_type_values.hpp"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/rclcpp.hpp"
#include "sensor_msgs/msg/joint_state.hpp"

namespace sst_ros_hardware
{

using hardware_interface::return_type;
using sensor_msgs::msg::JointState;

constexpr char kIdle[] = "idle";  // frame_id of a state that is no sample of a run
constexpr double kNone = std::numeric_limits<double>::quiet_NaN();

class LockstepSystem : public hardware_interface::SystemInterface
{
public:
  hardware_interface::CallbackReturn on_init(
    const hardware_interface::HardwareComponentInterfaceParams & params) override
  {
    using hardware_interface::CallbackReturn;
    if (SystemInterface::on_init(params) != CallbackReturn::SUCCESS) {
      return CallbackReturn::ERROR;
    }
    for (const auto & joint : get_hardware_info().joints) {
      for (const auto & command : joint.command_interfaces) {
        if (command.name != hardware_interface::HW_IF_EFFORT) {
          RCLCPP_ERROR(
            get_node()->get_logger(), "command_interface of %s = %s: must be effort",
            joint.name.c_str(), command.name.c_str());
          return CallbackReturn::ERROR;
        }
        actuators_.push_back(joint.name);
      }
    }
    try {
      timeout_ = std::chrono::duration<double>(std::stod(parameter("timeout", "1.0")));
    } catch (const std::exception &) {
      RCLCPP_ERROR(
        get_node()->get_logger(), "timeout = '%s': must be a number of seconds",
        parameter("timeout", "").c_str());
      return CallbackReturn::ERROR;
    }
    if (!actuators_.empty()) {
      commands_ = get_node()->create_publisher<JointState>(
        parameter("joint_commands_topic", "/sst_simulator/commands_stamped"), rclcpp::QoS(10));
    }
    rclcpp::SubscriptionOptions options;  // in a group that no executor has
    options.callback_group = group_ = get_node()->create_callback_group(
      rclcpp::CallbackGroupType::MutuallyExclusive, false);
    states_ = get_node()->create_subscription<JointState>(
      parameter("joint_states_topic", "/joint_states"), rclcpp::QoS(10),
      [](JointState::ConstSharedPtr) {}, options);
    arrivals_.add_subscription(states_);
    return CallbackReturn::SUCCESS;
  }

  return_type read(const rclcpp::Time & time, const rclcpp::Duration &) override
  {
    is_due_ = false;
    if (time.get_clock_type() != RCL_ROS_TIME) {
      RCLCPP_ERROR(
        get_node()->get_logger(), "use_sim_time of the controller manager = false: must be true");
      return return_type::ERROR;
    }
    const auto end = std::chrono::steady_clock::now() + timeout_;
    rclcpp::MessageInfo info;
    while (stamp_ns_ < time.nanoseconds()) {
      if (states_->take(sample_, info)) {
        stamp_ns_ = rclcpp::Time(sample_.header.stamp).nanoseconds();
        continue;
      }
      const std::chrono::duration<double> left = end - std::chrono::steady_clock::now();
      if (left.count() <= 0.0 || !has_arrived(left)) {
        RCLCPP_WARN(
          get_node()->get_logger(), "no joint state of %ld ns within %g s: not answered",
          static_cast<long>(time.nanoseconds()), timeout_.count());
        return return_type::OK;
      }
    }
    if (stamp_ns_ != time.nanoseconds()) {
      return return_type::OK;  // before a run: the next update answers it
    }
    is_due_ = true;
    set(sample_.position, hardware_interface::HW_IF_POSITION);
    set(sample_.velocity, hardware_interface::HW_IF_VELOCITY);
    set(sample_.effort, hardware_interface::HW_IF_EFFORT);
    return return_type::OK;
  }

  /// Answer the sample of this update. An actuator that no controller commands gets zero torque;
  /// before a run, where no controller commands any, nothing is sent: a command starts the run.
  return_type write(const rclcpp::Time &, const rclcpp::Duration &) override
  {
    if (!is_due_ || !commands_) {
      return return_type::OK;
    }
    JointState answer;
    answer.header.stamp = sample_.header.stamp;
    bool commanded = false;
    for (const auto & name : actuators_) {
      const double torque = get_command(name + "/" + hardware_interface::HW_IF_EFFORT);
      commanded = commanded || !std::isnan(torque);
      answer.name.push_back(name);
      answer.effort.push_back(std::isnan(torque) ? 0.0 : torque);
    }
    if (commanded || sample_.header.frame_id != kIdle) {
      commands_->publish(answer);
    }
    return return_type::OK;
  }

  /// Forget the command of a controller that is deactivated.
  return_type perform_command_mode_switch(
    const std::vector<std::string> &, const std::vector<std::string> & stopped) override
  {
    for (const auto & name : actuators_) {
      const auto interface = name + "/" + hardware_interface::HW_IF_EFFORT;
      for (const auto & one : stopped) {
        if (one == interface) {
          set_command(interface, kNone);
        }
      }
    }
    return return_type::OK;
  }

private:
  std::string parameter(const std::string & name, const std::string & otherwise) const
  {
    const auto & given = get_hardware_info().hardware_parameters;
    const auto found = given.find(name);
    return found == given.end() ? otherwise : found->second;
  }

  bool has_arrived(std::chrono::duration<double> within)
  {
    const auto wait = std::chrono::duration_cast<std::chrono::nanoseconds>(within);
    return arrivals_.wait(wait).kind() == rclcpp::WaitResultKind::Ready;
  }

  /// Set the state interfaces of a kind that the tag has, by the names in the sample.
  void set(const std::vector<double> & values, const std::string & kind)
  {
    for (std::size_t i = 0; i < values.size() && i < sample_.name.size(); ++i) {
      const auto interface = sample_.name[i] + "/" + kind;
      if (has_state(interface)) {
        set_state(interface, values[i]);
      }
    }
  }

  std::vector<std::string> actuators_;
  std::chrono::duration<double> timeout_{1.0};
  rclcpp::Publisher<JointState>::SharedPtr commands_;
  rclcpp::CallbackGroup::SharedPtr group_;
  rclcpp::Subscription<JointState>::SharedPtr states_;
  rclcpp::WaitSet arrivals_;
  JointState sample_;  // the last that was taken, with this stamp
  std::int64_t stamp_ns_ = 0;
  bool is_due_ = false;  // it is that of this update
};

}  // namespace sst_ros_hardware

PLUGINLIB_EXPORT_CLASS(sst_ros_hardware::LockstepSystem, hardware_interface::SystemInterface)
