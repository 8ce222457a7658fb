# Passed by ./uw as CMAKE_PROJECT_INCLUDE where nothing but our own Python nodes uses the messages: leaves out the C++
# libraries and compiles the rest in few large pieces, which is 40 % of the whole work. A plain `colcon build` of these
# packages does not see this file. (The introspection library for C stays: rmw_fastrtps asks for it.)

if(PROJECT_IS_TOP_LEVEL)
  find_package(ament_cmake REQUIRED)
  # Each generator registers itself once, when its package is found first.
  find_package(rosidl_default_generators REQUIRED)
  list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")

  function(uw_compile_in_large_pieces)
    foreach(part rosidl_typesupport_c rosidl_typesupport_fastrtps_c rosidl_generator_py)
      set_target_properties(${PROJECT_NAME}__${part} PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 12)
    endforeach()
  endfunction()
  cmake_language(DEFER CALL uw_compile_in_large_pieces)
endif()
