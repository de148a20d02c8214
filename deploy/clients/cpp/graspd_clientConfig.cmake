include(CMakeFindDependencyMacro)
find_dependency(cppzmq)
find_dependency(nlohmann_json)
include(${CMAKE_CURRENT_LIST_DIR}/graspd_clientTargets.cmake)
